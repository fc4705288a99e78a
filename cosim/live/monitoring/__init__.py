"""Who follows a live run: terminal, log, metrics, ROS 2."""
