"""The loop's process: the cycle, the state machine, commands, stop reactions, the slave watcher's thread."""
