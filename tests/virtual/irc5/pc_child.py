"""Joins the namespaces of a controller and leads joint 1: `pc_child.py PID PORT DEGREES` prints where it ends."""

from __future__ import annotations

import socket
import sys

from rtcp.fieldbus.interface import enter
from tests.virtual.irc5.test_process import lead

if __name__ == "__main__":
    enter(int(sys.argv[1]))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as pc:
        pc.bind(("127.0.0.1", int(sys.argv[2])))
        pc.settimeout(10.0)
        print(lead(pc, float(sys.argv[3])).actual[0])
