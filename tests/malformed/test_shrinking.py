"""Mutated frames by hypothesis: few of them, but one that breaks something is made as small as it can be.

The million of `benchmarks/mutations.py` is drawn by a seeded generator of our own: it knows datagrams and mailboxes, a
million take minutes, and a seed plays them again. What it finds it cannot make smaller; that is hypothesis's part here.
"""

from __future__ import annotations

import random as chance
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from hypothesis import given, note, settings
from hypothesis import strategies as st

from rtcp.fieldbus import BusError
from tests.malformed.corpus import frames
from tests.malformed.line import OP, SIZES, Line
from tests.malformed.mutate import mutated
from tests.malformed.mutated_answers import LONGEST_S, Loopback, Master, looped
from tests.malformed.mutated_frames import writes
from tests.samples import examples

EXAMPLES = examples(200)
WHOLE = 3 * len(SIZES)
"""Working counter of an exchange with all slaves."""
FEW = 2
"""Mutated answers of an action; few, as hypothesis draws short sequences."""
_lines: list[Line] = []


@contextmanager
def line_in_op() -> Iterator[Line]:
    """The line of the previous example if it is still sound, else a new one, so that a failure is reproducible."""
    line = _lines.pop() if _lines else Line()
    if line.states != [OP] * len(SIZES) or line.exchange() != WHOLE:
        line.start(OP)
    yield line
    _lines.append(line)


class FirstStruck(Loopback):
    """Mutates only the first answers and records them."""

    def send(self, frame: bytes) -> None:
        self.share = 1.0 if self.mutated < FEW else 0.0
        super().send(frame)
        if self.share:
            note(f"to {frame.hex()}\n  come {[answer.hex() for answer in self._waiting]}")


@settings(max_examples=EXAMPLES)
@given(st.randoms(use_true_random=False), st.sampled_from(frames()))
def test_no_mutated_frame_breaks_the_segment_or_changes_what_it_does_not_write(
    random: chance.Random, whole: bytes
) -> None:
    frame = bytes(mutated(whole, random))
    note(f"the frame: {frame.hex()}")
    with line_in_op() as line:
        before = line.targets()
        answer = line.give(frame, 1000)
        assert answer is None or len(answer) == len(frame)
        assert writes(frame) or line.targets() == before
        line.start(OP)


@settings(max_examples=EXAMPLES)
@given(st.randoms(use_true_random=False), st.integers(0, 10), st.integers(0, len(SIZES) - 1), st.integers(0, 99))
def test_no_mutated_answer_gets_more_than_a_sentence_out_of_the_masters_parsers(
    random: chance.Random, action: int, slave: int, seed: int
) -> None:
    with line_in_op() as line, looped(line, random, FirstStruck) as (port, loopback):
        began = line.now
        said: Sequence[str] = ()
        try:
            Master(line, port, chance.Random(seed)).actions[action](slave)
        except BusError as error:
            said = error.sentences
        assert all(len(sentence) > 10 for sentence in said)
        assert line.now - began < LONGEST_S * 1e9
        loopback.close()
