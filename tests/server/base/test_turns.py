"""Fair turns at a bounded number of slots: which of the pieces that wait begin, for given lines.

Not proved here: what the pieces do (test_imports_fair, test_webhooks_fair, test_orbits).
"""

from splatmill_server.base.turns import Turns


def test_lines_take_turns_whatever_their_length() -> None:
    turns = Turns(slots=4, of_line=4)
    waiting = [("ann", f"a{n}") for n in range(50)] + [("bob", "b0"), ("bob", "b1")]
    assert turns.choose([], waiting) == ["a0", "b0"]  # the other half is for those who hold no slot
    assert turns.choose(["ann", "bob"], [*waiting[1:50], ("bob", "b1"), ("eve", "e0")]) == ["e0"]


def test_one_line_holds_no_more_than_its_share() -> None:
    turns = Turns(slots=8, of_line=3)
    assert turns.choose([], [("ann", n) for n in range(9)]) == [0, 1, 2]
    assert turns.choose(["ann"] * 3, [("ann", 3)]) == []
    # However many others work, a line that holds no slot gets one of the second half.
    held = ["ann", "ann", "ann", "bob"]
    assert turns.choose(held, [("bob", 4), ("ann", 5), ("eve", 6), ("dan", 7)]) == [6, 7]
    assert turns.choose(["ann", "bob", "eve", "dan"] * 2, [("fay", 8)]) == []


def test_a_line_that_was_served_goes_behind_the_others() -> None:
    turns = Turns(slots=1, of_line=1)
    waiting = {"ann": ["a0", "a1", "a2"], "bob": ["b0", "b1"]}
    order = []
    while any(waiting.values()):
        (piece,) = turns.choose([], [(line, piece) for line, pieces in waiting.items() for piece in pieces])
        order.append(piece)
        for pieces in waiting.values():
            pieces[:] = [other for other in pieces if other != piece]
    assert order == ["a0", "b0", "a1", "b1", "a2"]
