# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Lanes and the ways across junctions, joined to routes that traffic follows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pred.data.world.motion import Path
from pred.data.world.town import LANE_M, Layout, Node, Stretch, lane_range

LATERAL_MPS2 = 3.2
"""Acceleration in bends, which limits the speed there."""
BRAKING_MPS2 = 2.0
RIGHT_RADIUS_M, LEFT_RADIUS_M = 9.0, 11.0


@dataclass(frozen=True)
class Section:
    """A lane of a stretch, or a way across the junction at ``node``.

    Attributes:
        key: identity; sections of different routes with one key are the same piece of road. ("lane" or "turn",
            node it comes from, node it leads to or crosses, node after that, lane); the last node of a lane is its
            second.
        points: [n, 2] centre line.
        radius_m: of the bend; infinite where it runs straight on.
        node: junction that it crosses; None for a lane.
        approach: where traffic on it comes from.
    """

    key: tuple[str, Node, Node, Node, int]
    points: NDArray[np.float64]
    radius_m: float
    node: Node | None
    approach: Node


@dataclass(frozen=True)
class Route:
    """Sections one after the other.

    Attributes:
        sections: lanes and ways across junctions in turn, a lane first.
        starts_m: [len(sections) + 1] distance along the route at which each begins, and the end of the last.
    """

    sections: tuple[Section, ...]
    starts_m: NDArray[np.float64]

    @cached_property
    def path(self) -> Path:
        """Centre line on the road's surface."""
        points = [self.sections[0].points[:1]] + [section.points[1:] for section in self.sections]
        flat = np.concatenate(points)
        return Path(np.column_stack([flat, np.zeros(len(flat))]))

    @cached_property
    def speed_limit_mps(self) -> NDArray[np.float64]:
        """Speed at each metre of the route that bends, and braking before them, allow."""
        limit = np.full(int(self.starts_m[-1]) + 2, 30.0)
        for section, start_m, end_m in zip(self.sections, self.starts_m, self.starts_m[1:], strict=False):
            if np.isfinite(section.radius_m):
                # The first and the last piece are straight; the axles follow the front by some metres.
                before_m, after_m = (float(np.linalg.norm(section.points[k] - section.points[k + 1])) for k in (0, -2))
                bend = slice(int(start_m + before_m), int(end_m - after_m) + 4)
                limit[bend] = np.minimum(limit[bend], np.sqrt(LATERAL_MPS2 * section.radius_m))
        for metre in range(len(limit) - 2, -1, -1):
            limit[metre] = min(limit[metre], np.sqrt(limit[metre + 1] ** 2 + 2 * BRAKING_MPS2))
        return limit


def lane_section(stretch: Stretch, lane: int) -> Section:
    """Lane ``lane`` of a stretch; 0 is the one beside the centre line."""
    right_m = (lane + 0.5) * LANE_M
    points = stretch.place(lane_range(stretch), [right_m, right_m])
    return Section(("lane", stretch.a, stretch.b, stretch.b, lane), points, np.inf, None, stretch.a)


def crossing_section(before: Stretch, lane: int, after: Stretch) -> tuple[Section, int] | None:
    """The way from lane ``lane`` of ``before`` into ``after``, and the lane it leads to; None if there is none.

    Right turns start from and lead to the outer lane, left turns the inner one; straight on keeps the lane.
    """
    turn = float(before.ahead[0] * after.ahead[1] - before.ahead[1] * after.ahead[0])
    if abs(turn) < 0.5:
        target = lane
    elif turn < 0:
        target = after.lanes - 1
        if lane != before.lanes - 1:
            return None
    else:
        target = 0
        if lane != 0:
            return None
    start, end = lane_section(before, lane).points[1], lane_section(after, target).points[0]
    key = ("turn", before.a, before.b, after.b, lane)
    if abs(turn) < 0.5:
        return Section(key, np.array([start, end]), np.inf, before.b, before.a), target
    corner = start + before.ahead * ((end - start) @ before.ahead)
    room_m = min(float(np.linalg.norm(corner - start)), float(np.linalg.norm(end - corner)))
    radius_m = min(room_m, RIGHT_RADIUS_M if turn < 0 else LEFT_RADIUS_M)
    angle = np.linspace(0.0, np.pi / 2, 33)
    middle = corner - radius_m * before.ahead + radius_m * after.ahead
    arc = middle + radius_m * (np.sin(angle)[:, None] * before.ahead - np.cos(angle)[:, None] * after.ahead)
    return Section(key, np.concatenate([[start], arc, [end]]), radius_m, before.b, before.a), target


def draw_route(
    layout: Layout,
    rng: np.random.Generator,
    start: tuple[Node, Node, int],
    length_m: float,
    turn_within: int = 0,
) -> Route:
    """A route from a lane (from node, to node, lane) on, drawn at each junction, of at least ``length_m``.

    With ``turn_within`` it turns at one of the first so many junctions.
    """
    a, b, lane = start
    sections = [lane_section(layout.stretch(a, b), lane)]
    starts_m = [0.0, _length_m(sections[0])]
    turned = False
    junctions = 0
    while starts_m[-1] < length_m:
        before = layout.stretch(a, b)
        ways = []
        for c in layout.neighbours(b):
            way = crossing_section(before, lane, layout.stretch(b, c)) if c != a else None
            if way is not None:
                ways.append((c, *way))
        junctions += 1
        if junctions == turn_within and not turned:
            ways = [way for way in ways if np.isfinite(way[1].radius_m)] or ways
        c, section, lane = ways[int(rng.integers(len(ways)))]
        turned = turned or bool(np.isfinite(section.radius_m))
        a, b = b, c
        for added in (section, lane_section(layout.stretch(a, b), lane)):
            sections.append(added)
            starts_m.append(starts_m[-1] + _length_m(added))
    return Route(tuple(sections), np.array(starts_m))


def _length_m(section: Section) -> float:
    return float(np.linalg.norm(np.diff(section.points, axis=0), axis=1).sum())
