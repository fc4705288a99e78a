"""Data that the processes exchange: wire format, roles, record tables.

``roles.py`` says who sends what to whom, ``wire_format.py`` has the datagrams, ``record_tables.py``
the rows that are recorded of them. ``ros2_messages.py`` and ``ros2_node.py`` do the same for nodes
of ROS 2.
"""
