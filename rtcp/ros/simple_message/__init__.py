"""Simple Message, the protocol of ROS-Industrial drivers: its bytes, a server of this arm, a client of other makers'
(`docs/simple_message.md`).
"""
