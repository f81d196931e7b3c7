"""The panel: the arm in a browser. A process of its own, and a client of `rtcp.api` like any other."""
