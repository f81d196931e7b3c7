"""Simple Message, the protocol of ROS-Industrial drivers: its messages and frames (`docs/simple_message.md`)."""
