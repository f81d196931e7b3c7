"""Simple Message, the protocol of ROS-Industrial drivers: a server for this arm, a client for robot controllers
(`docs/simple_message.md`).
"""
