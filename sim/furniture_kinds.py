"""The furniture there is, and what belongs into which room."""

from __future__ import annotations

from dataclasses import dataclass

Range = tuple[float, float]


@dataclass(frozen=True)
class Kind:
    """What a kind of furniture measures along the wall and away from it, metres."""

    width: Range
    depth: Range
    corner: bool = False


_BED = Kind((1.4, 1.8), (2.0, 2.1))
_SINGLE_BED = Kind((0.9, 1.0), (2.0, 2.1), corner=True)
_WARDROBE = Kind((1.2, 2.4), (0.58, 0.65), corner=True)
_CHEST = Kind((0.8, 1.3), (0.42, 0.5))
_DESK = Kind((1.2, 1.6), (0.6, 0.8))
_SOFA = Kind((1.8, 2.6), (0.85, 1.0))
_BOARD = Kind((1.2, 2.0), (0.38, 0.5))
_SHELF = Kind((0.8, 2.2), (0.3, 0.4), corner=True)
_PIANO = Kind((1.4, 1.5), (0.6, 0.65))
_COUNTER = Kind((1.8, 3.4), (0.6, 0.65), corner=True)
_FRIDGE = Kind((0.6, 0.75), (0.6, 0.7), corner=True)
_TUB = Kind((1.6, 1.8), (0.7, 0.8), corner=True)
_SHOWER = Kind((0.8, 1.0), (0.8, 1.0), corner=True)
_BASIN = Kind((0.5, 0.9), (0.45, 0.5))
_TOILET = Kind((0.38, 0.42), (0.6, 0.7))
_WASHER = Kind((0.6, 0.6), (0.6, 0.65), corner=True)
_RACK = Kind((1.0, 2.6), (0.4, 0.6), corner=True)
_CABINET = Kind((0.7, 1.2), (0.3, 0.36))

ALONG_WALLS: dict[str, tuple[tuple[Kind, float], ...]] = {
    "bedroom": ((_BED, 0.65), (_WARDROBE, 0.95), (_DESK, 0.5), (_CHEST, 0.6), (_SHELF, 0.4)),
    "child": ((_SINGLE_BED, 1.0), (_WARDROBE, 0.8), (_DESK, 0.9), (_SHELF, 0.7), (_SINGLE_BED, 0.25)),
    "living": ((_SOFA, 0.9), (_BOARD, 0.9), (_SHELF, 0.8), (_SHELF, 0.5), (_PIANO, 0.2), (_CHEST, 0.4)),
    "dining": ((_BOARD, 0.7), (_SHELF, 0.5), (_CHEST, 0.4)),
    "kitchen": ((_COUNTER, 1.0), (_COUNTER, 0.7), (_FRIDGE, 0.9), (_CABINET, 0.5)),
    "bath": ((_TUB, 0.6), (_SHOWER, 0.5), (_TOILET, 0.9), (_BASIN, 0.9), (_WASHER, 0.5)),
    "study": ((_DESK, 1.0), (_SHELF, 0.9), (_SHELF, 0.8), (_SOFA, 0.3), (_CHEST, 0.4)),
    "store": ((_RACK, 1.0), (_RACK, 0.9), (_RACK, 0.6), (_WASHER, 0.3)),
    "corridor": ((_CABINET, 0.5), (_CABINET, 0.3)),
}
"""What stands against the walls of each kind of room, with its probability, in the order in which it is placed."""
