"""RoboMME: the sixteen tasks, their scenes, the robot, and the recording of demonstrations."""
