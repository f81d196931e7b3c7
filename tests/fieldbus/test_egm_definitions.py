"""EGM's messages: what is loaded is what the .proto file says."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

import rtcp.fieldbus

FOLDER = Path(rtcp.fieldbus.__file__).parent


def test_the_compiled_definitions_are_those_of_the_proto_file(tmp_path: Path) -> None:
    protoc = pytest.importorskip("grpc_tools.protoc", reason="grpcio-tools is not installed: pip install 'rtcp[dev]'")
    made = tmp_path / "made.binpb"
    assert protoc.main(["protoc", f"-I{FOLDER}", f"--descriptor_set_out={made}", "rtcp_egm.proto"]) == 0
    assert made.read_bytes() == (FOLDER / "rtcp_egm.binpb").read_bytes()
