"""Simple Message, the protocol of ROS-Industrial drivers: a server of this arm, a client of other makers'
(`docs/simple_message.md`).
"""
