"""What follows from a survey: how many layers, which roles say nothing. Pure arithmetic; no torch, no files.

A role that says nothing is held at the value that means so, not dropped: the network still knows that, say, nothing
moves, and reads no numbers for it. Dropped roles are unknown to it, which costs a few per cent of error.
"""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.survey import STIRRING, Survey

# role -> what it is the only use of: without blur it does not matter where a ray left the lens
COMPANIONS = {"coc": "lens", "motion": "time"}
WORDS = {"coc": "defocus", "motion": "motion"}


@dataclass(frozen=True)
class Decisions:
    """What is decided once for a shot.

    one_layer : nothing is hit; else as many layers as the network was trained for. That no depth mixes within pixels is
        no reason for less: on such crops one layer costs 5 % relMSE and more, since layers part more than depths
    held : coc and lens without defocus, motion and time without motion
    """

    one_layer: bool = False
    held: frozenset[str] = frozenset()

    def lines(self) -> list[str]:
        """For a reader."""
        return [f"no {WORDS[role]}: {' and '.join(r for r in (role, COMPANIONS[role]) if r in self.held)} held"
                for role in COMPANIONS if role in self.held]


def decide(seen: Survey) -> Decisions:
    """The decisions of a shot, from the frame that stands for it."""
    return Decisions(not seen.hits, still_roles(seen))


def still_roles(seen: Survey) -> frozenset[str]:
    """coc and lens without defocus, motion and time without motion. Nothing in a frame that hits nothing."""
    if not seen.hits:
        return frozenset()
    still = {role for role in COMPANIONS if seen.largest.get(role, STIRRING * 2) <= STIRRING}
    return frozenset(still | {COMPANIONS[role] for role in still if COMPANIONS[role] in seen.largest})


def zero_roles(seen: Survey) -> frozenset[str]:
    """Roles that are 0 in every sample: holding them changes nothing at all, so every frame decides for itself."""
    return frozenset(role for role, size in seen.largest.items() if size == 0)


def surprises(shot: Decisions, seen: Survey) -> dict[str, str]:
    """What a frame has that the shot was decided to do without: what, and a line about it."""
    still = still_roles(seen)
    found = {role: f"has {WORDS[role]}, which the frame that decided for the shot has not" for role in WORDS
             if role in shot.held and role in seen.largest and seen.hits and role not in still}
    if shot.one_layer and seen.hits:
        found["layers"] = "has surfaces, but the frame that decided for the shot has none, so there is one layer"
    return found
