"""The controller needs protobuf, of the optional dependencies `abb`."""

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")
