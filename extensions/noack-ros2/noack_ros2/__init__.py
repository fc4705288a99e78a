"""ROS 2 for noack: messages, a bridge, plants and controllers that are nodes, and files as MCAP."""
