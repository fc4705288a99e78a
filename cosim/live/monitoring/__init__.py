"""Who follows a live run: terminal, log, ROS 2."""
