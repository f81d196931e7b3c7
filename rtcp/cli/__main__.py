"""`python -m rtcp.cli`: the same as the command `rtcp`."""

from rtcp.cli import main

raise SystemExit(main())
