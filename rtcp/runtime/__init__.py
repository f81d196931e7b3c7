"""The running platform: the loop, the blackboard between its processes, the gateway, the launcher."""
