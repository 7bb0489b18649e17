"""Data: RoboMME's HDF5 files → LeRobot datasets → training samples, with a cache of vision tokens
beside them.
"""
