"""Policies that another program serves: `RemotePolicy` acts through a server as others through
their own network.
"""
