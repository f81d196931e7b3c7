"""Communication between processes: shared memory, commands, events, sessions, the client of the control socket."""
