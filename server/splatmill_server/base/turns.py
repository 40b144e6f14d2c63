"""Fair turns at a bounded number of slots. Pieces of work wait in lines, one for each owner."""

from collections import Counter, deque
from collections.abc import Hashable, Iterable
from typing import TypeVar

Piece = TypeVar("Piece", bound=Hashable)


class Turns:
    """Chooses which pieces begin next.

    The line that holds the fewest slots comes first, and among equals the one that has waited longest for a turn. The
    second half of the slots is for lines that hold none: pieces that take hours must not keep other owners waiting.

    slots: pieces that are worked on at once.
    of_line: how many of them may be of one line.
    """

    def __init__(self, slots: int, of_line: int) -> None:
        self._slots = slots
        self._of_line = of_line
        self._turn = 0
        self._last: dict[str, int] = {}
        """Number of the last turn of each line that waits."""

    def choose(self, working: Iterable[str], waiting: Iterable[tuple[str, Piece]]) -> list[Piece]:
        """Return the pieces that begin now.

        working: the line of each piece that holds a slot.
        waiting: the other pieces with their lines, in the order in which those of one line begin.
        """
        held = Counter(working)
        lines: dict[str, deque[Piece]] = {}
        for line, piece in waiting:
            lines.setdefault(line, deque()).append(piece)
        self._last = {line: turn for line, turn in self._last.items() if line in lines}
        chosen: list[Piece] = []
        while lines and held.total() < self._slots:
            line = min(lines, key=lambda line: (held[line], self._last.get(line, 0)))
            if held[line] >= self._of_line or (held[line] and held.total() >= self._slots / 2):
                break  # no other line holds fewer
            chosen.append(lines[line].popleft())
            held[line] += 1
            self._turn += 1
            self._last[line] = self._turn
            if not lines[line]:
                del lines[line]
        return chosen
