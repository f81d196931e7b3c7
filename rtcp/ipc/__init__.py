"""What processes say to each other: shared memory, commands, events, sessions, the client of the control socket."""
