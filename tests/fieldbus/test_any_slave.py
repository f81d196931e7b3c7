"""Slaves without mailbox, with a few bits, with several sync managers a direction, and on branches, brought to OP."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.alone

DIRECT = ("coupler", "bits2", "bits4", "output", "bits4", "bits7", "bits6", "input", "bits1", "bits6")


def test_neighbours_that_share_bytes_each_have_their_own_bits(start_segment):
    result = start_segment(DIRECT).master("terminals", kinds=DIRECT)["result"]
    assert result["states"] == ["OP"] * len(DIRECT)
    # Two for outputs and one for inputs each; SOEM expects too few.
    assert result["expected_wkc"] == 7 * 3 + 2 + 1
    assert set(result["wkcs"][-50:]) <= {result["expected_wkc"], -1}
    assert result["soem_expected"] < result["expected_wkc"]
    for sent, received in result["patterns"]:
        assert [data for data, kind in zip(received, DIRECT, strict=True) if kind.startswith("bits")] == [
            data for data, kind in zip(sent, DIRECT, strict=True) if kind.startswith("bits")
        ]


def test_several_sync_managers_of_a_direction_each_get_their_fmmu(start_segment):
    kinds = ("areas", "pairs", "bits3")
    entries = ("areas", "pairs, options: {sync_error_limit: 0}", "bits3")
    result = start_segment(entries).master("terminals", kinds=kinds)["result"]
    assert result["states"] == ["OP"] * 3
    assert result["expected_wkc"] == 9
    for sent, received in result["patterns"]:
        # The first of its three areas of outputs comes back in an input of 16 bits.
        assert received[0] == sent[0][:2] + "00"
        assert received[1:] == sent[1:]
    assert "".join(result["objects"]) == result["patterns"][-1][0][0]
    assert result["sync"] == "3007"
