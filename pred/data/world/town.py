# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Plan of a town: a grid of roads of unequal spacing, and the map that follows from it.

World frame, metres: x east, y north, z up; roads are the plane z = 0, and the town lies in [0, EXTENT_M] on both
axes. Traffic keeps to the right. Where four roads meet is a crossing; the town's rim and one road that is left out
give T-junctions and bends.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

EXTENT_M = 400.0
GRID = 4
"""Roads in each direction."""
LANE_M = 3.5
PARKING_M = 2.7
"""Width of the strip for parked cars between the outer lane and the kerb."""
SIDEWALK_M = 3.2
CORNER_M = 4.0
"""Radius of the kerbs at crossings."""
CROSSING_M = (4.2, 7.2)
"""Zebra crossings: from here to there, measured from the kerb line of the road that is met."""
STOP_LINE_M = (8.0, 8.4)
STOP_M = 8.6
"""Lanes end here, and begin here behind the crossing."""
KERB_Z_M, TERRAIN_Z_M = 0.13, 0.16
FAR_M = 250.0
"""The ground goes on that far around the town."""

Node = tuple[int, int]
"""Column and row of a place where roads meet."""


@dataclass(frozen=True)
class Road:
    """A straight road through the town: x (or y) of its centre line, lanes in each direction."""

    at_m: float
    lanes: int

    @property
    def half_m(self) -> float:
        """From the centre line to the kerb."""
        return self.lanes * LANE_M + PARKING_M


@dataclass(frozen=True)
class Stretch:
    """The road from node ``a`` to the next node ``b``, with coordinates of its own: ``along`` from the middle of
    ``a`` towards ``b`` and ``right`` of the centre line, metres.

    Attributes:
        start: [2] world coordinates of the middle of ``a``.
        ahead: [2] unit vector towards ``b``.
        length_m: between the middles of ``a`` and ``b``.
        lanes: in this direction.
        half_m: from the centre line to the kerb.
        kerb_a_m, kerb_b_m: ``along`` of the kerb lines of the roads that are met at ``a`` and ``b``.
    """

    a: Node
    b: Node
    start: NDArray[np.float64]
    ahead: NDArray[np.float64]
    length_m: float
    lanes: int
    half_m: float
    kerb_a_m: float
    kerb_b_m: float

    @property
    def yaw_rad(self) -> float:
        """Heading of the traffic."""
        return float(np.arctan2(self.ahead[1], self.ahead[0]))

    def place(self, along: ArrayLike, right: ArrayLike) -> NDArray[np.float64]:
        """World coordinates [..., 2]."""
        along, right = np.asarray(along, dtype=np.float64), np.asarray(right, dtype=np.float64)
        across = np.array([self.ahead[1], -self.ahead[0]])
        return self.start + along[..., None] * self.ahead + right[..., None] * across

    def rectangle(self, along: tuple[float, float], right: tuple[float, float]) -> NDArray[np.float64]:
        """Polygon [4, 2], counter-clockwise."""
        (along_low, along_high), (right_low, right_high) = along, right
        return self.place(
            [along_low, along_high, along_high, along_low], [right_high, right_high, right_low, right_low]
        )


@dataclass(frozen=True)
class Block:
    """Raised ground between roads.

    Attributes:
        outline: [n, 2] kerb line, convex, counter-clockwise.
        low, high: [2] corners of the terrain inside the walkways.
        walkways: parts of the outline [n, 2] that are paved.
        inner: whether roads run on all four sides.
    """

    outline: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    walkways: tuple[NDArray[np.float64], ...]
    inner: bool


class Layout:
    """Where the roads run. ``rng`` draws their spacing, their lanes and the one that is left out."""

    def __init__(self, rng: np.random.Generator) -> None:
        def roads() -> tuple[Road, ...]:
            at_m = 52.0 + np.concatenate([[0.0], np.cumsum(rng.uniform(80.0, 96.0, GRID - 1))])
            # The roads along the rim, where bends are, have one lane; so has one of the two between them.
            lanes = [1] * GRID
            if rng.random() < 0.6:
                lanes[int(rng.integers(1, GRID - 1))] = 2
            return tuple(Road(float(at), count) for at, count in zip(at_m, lanes, strict=True))

        self.columns, self.rows = roads(), roads()
        inner = [((1, 1), (2, 1)), ((1, 2), (2, 2)), ((1, 1), (1, 2)), ((2, 1), (2, 2))]
        self.missing: frozenset[Node] | None = frozenset(inner[int(rng.integers(4))]) if rng.random() < 0.8 else None
        self.nodes: tuple[Node, ...] = tuple((i, j) for i in range(GRID) for j in range(GRID))

    def centre(self, node: Node) -> NDArray[np.float64]:
        """[2] where the centre lines meet."""
        return np.array([self.columns[node[0]].at_m, self.rows[node[1]].at_m])

    def neighbours(self, node: Node) -> tuple[Node, ...]:
        """Nodes that a road leads to."""
        i, j = node
        around = ((i + 1, j), (i, j + 1), (i - 1, j), (i, j - 1))
        return tuple(other for other in around if self.has_road(node, other))

    def has_road(self, a: Node, b: Node) -> bool:
        """Whether a road joins two nodes of the grid, of which either may lie outside."""
        inside = all(0 <= index < GRID for index in (*a, *b))
        return inside and frozenset((a, b)) != self.missing

    def is_junction(self, node: Node) -> bool:
        """Whether three or four roads meet: with stop lines and crossings, other than in a bend."""
        return len(self.neighbours(node)) > 2

    def stretch(self, a: Node, b: Node) -> Stretch:
        """The road from ``a`` to its neighbour ``b``."""
        offset = self.centre(b) - self.centre(a)
        length_m = float(np.abs(offset).sum())
        horizontal = a[1] == b[1]
        road = self.rows[a[1]] if horizontal else self.columns[a[0]]
        met_a, met_b = (self.columns[node[0]] if horizontal else self.rows[node[1]] for node in (a, b))
        return Stretch(
            a,
            b,
            self.centre(a),
            offset / length_m,
            length_m,
            road.lanes,
            road.half_m,
            met_a.half_m,
            length_m - met_b.half_m,
        )

    def stretches(self) -> Iterator[Stretch]:
        """Every road between neighbours, once in each direction."""
        for a in self.nodes:
            for b in self.neighbours(a):
                yield self.stretch(a, b)

    def blocks(self) -> Iterator[Block]:
        """All raised ground: the cells of the grid, and what fills the place of roads that are not there."""
        for i in range(GRID + 1):
            for j in range(GRID + 1):
                yield self._cell(i, j)
        for i in range(GRID + 1):
            for j in range(GRID):
                if not self.has_road((i - 1, j), (i, j)):
                    yield self._filler(i, j, horizontal=True)
                if not self.has_road((j, i - 1), (j, i)):
                    yield self._filler(j, i, horizontal=False)

    def _between(self, roads: Sequence[Road], index: int) -> tuple[float, float]:
        """From kerb to kerb, before road ``index``."""
        low = roads[index - 1].at_m + roads[index - 1].half_m if index > 0 else -FAR_M
        high = roads[index].at_m - roads[index].half_m if index < GRID else EXTENT_M + FAR_M
        return low, high

    def _cell(self, i: int, j: int) -> Block:
        x, y = self._between(self.columns, i), self._between(self.rows, j)
        # A corner is round where roads run along both of its sides.
        corners = (
            ((i - 1, j - 1), (i, j - 1), (i - 1, j)),
            ((i, j - 1), (i - 1, j - 1), (i, j)),
            ((i, j), (i - 1, j), (i, j - 1)),
            ((i - 1, j), (i, j), (i - 1, j - 1)),
        )
        radii = [
            CORNER_M if self.has_road(node, first) and self.has_road(node, second) else 0.0
            for node, first, second in corners
        ]
        outline = rounded_rectangle((x[0], y[0]), (x[1], y[1]), radii)
        near = (i > 0, j > 0, i < GRID, j < GRID)
        return _block(outline, x, y, near, inner=0 < i < GRID and 0 < j < GRID)

    def _filler(self, i: int, j: int, horizontal: bool) -> Block:
        """Ground in the place of the road that would lead to node (i, j) from the left or from below."""
        if horizontal:
            x, middle = self._between(self.columns, i), self.rows[j]
            y = (middle.at_m - middle.half_m, middle.at_m + middle.half_m)
            near = (i > 0, False, i < GRID, False)
        else:
            y, middle = self._between(self.rows, j), self.columns[i]
            x = (middle.at_m - middle.half_m, middle.at_m + middle.half_m)
            near = (False, j > 0, False, j < GRID)
        return _block(rounded_rectangle((x[0], y[0]), (x[1], y[1]), [0.0] * 4), x, y, near, inner=False)


def _block(
    outline: NDArray[np.float64],
    x: tuple[float, float],
    y: tuple[float, float],
    near: tuple[bool, bool, bool, bool],  # whether there is a walkway on the left, below, on the right, above
    inner: bool,
) -> Block:
    left, below, right, above = (SIDEWALK_M if walkway else 0.0 for walkway in near)
    low, high = np.array([x[0] + left, y[0] + below]), np.array([x[1] - right, y[1] - above])
    town = outline
    for normal, bound in (((-1, 0), 0.0), ((0, -1), 0.0), ((1, 0), EXTENT_M), ((0, 1), EXTENT_M)):
        town = clip(town, normal, bound)
    strips = []
    for walkway, normal, bound in zip(
        near, ((1, 0), (0, 1), (-1, 0), (0, -1)), (low[0], low[1], -high[0], -high[1]), strict=True
    ):
        if walkway:
            strips.append(clip(town, normal, float(bound)))
    return Block(outline, low, high, tuple(strips), inner)


@dataclass(frozen=True)
class TownMap:
    """What a map of the town shows.

    Attributes:
        polygons: by layer (drivable_area, road_segment, road_block, lane, ped_crossing, walkway, stop_line,
            carpark_area), [n, 2] float64 world metres, counter-clockwise, simple, without holes.
        lines: by layer (road_divider, lane_divider), polylines [n, 2].
        intersections: those of ``road_segment`` that are intersections.
    """

    polygons: dict[str, list[NDArray[np.float64]]]
    lines: dict[str, list[NDArray[np.float64]]]
    intersections: list[NDArray[np.float64]]


@dataclass(frozen=True)
class CarPark:
    """A car park right of a stretch, which its driveway crosses the walkway to: ``along`` and ``right`` of both."""

    stretch: Stretch
    along: tuple[float, float]
    right: tuple[float, float]
    driveway_along: tuple[float, float]


def town_map(layout: Layout, car_parks: Sequence[CarPark]) -> TownMap:
    """The map layers of a layout."""
    names = ("drivable_area", "road_segment", "road_block", "lane", "ped_crossing", "walkway", "stop_line")
    polygons: dict[str, list[NDArray[np.float64]]] = {name: [] for name in (*names, "carpark_area")}
    lines: dict[str, list[NDArray[np.float64]]] = {"road_divider": [], "lane_divider": []}
    intersections = []
    for node in layout.nodes:
        half = np.array([layout.columns[node[0]].half_m, layout.rows[node[1]].half_m])
        area = rounded_rectangle(layout.centre(node) - half, layout.centre(node) + half, [0.0] * 4)
        intersections.append(area)
        polygons["drivable_area"] += [area, *_corner_pieces(layout, node, half)]
        polygons["road_segment"].append(area)
    for stretch in layout.stretches():
        kerbs, lane_ends = (stretch.kerb_a_m, stretch.kerb_b_m), lane_range(stretch)
        polygons["road_block"].append(stretch.rectangle(kerbs, (0.0, stretch.half_m)))
        for lane in range(stretch.lanes):
            polygons["lane"].append(stretch.rectangle(lane_ends, (lane * LANE_M, (lane + 1) * LANE_M)))
            if lane > 0:
                lines["lane_divider"].append(stretch.place(lane_ends, [lane * LANE_M] * 2))
        if layout.is_junction(stretch.b):
            polygons["stop_line"].append(stretch.rectangle(stop_line(stretch), (0.0, stretch.lanes * LANE_M)))
            polygons["ped_crossing"].append(stretch.rectangle(zebra(stretch), (-stretch.half_m, stretch.half_m)))
        if stretch.a < stretch.b:  # once for both directions
            road = stretch.rectangle(kerbs, (-stretch.half_m, stretch.half_m))
            polygons["drivable_area"].append(road)
            polygons["road_segment"].append(road)
            lines["road_divider"].append(stretch.place(lane_ends, [0.0, 0.0]))
    for block in layout.blocks():
        polygons["walkway"] += block.walkways
    for park in car_parks:
        area = park.stretch.rectangle(park.along, park.right)
        driveway = park.stretch.rectangle(park.driveway_along, (park.stretch.half_m, park.right[0]))
        polygons["carpark_area"].append(area)
        polygons["drivable_area"] += [area, driveway]
    return TownMap(polygons, lines, intersections)


def lane_range(stretch: Stretch) -> tuple[float, float]:
    """``along`` between which a stretch has lanes."""
    return stretch.kerb_a_m + STOP_M, stretch.kerb_b_m - STOP_M


def zebra(stretch: Stretch) -> tuple[float, float]:
    """``along`` of the crossing before node b."""
    return stretch.kerb_b_m - CROSSING_M[1], stretch.kerb_b_m - CROSSING_M[0]


def stop_line(stretch: Stretch) -> tuple[float, float]:
    """``along`` of the stop line before node b."""
    return stretch.kerb_b_m - STOP_LINE_M[1], stretch.kerb_b_m - STOP_LINE_M[0]


def _corner_pieces(layout: Layout, node: Node, half: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Road surface between a round kerb and the corner that a square one would have."""
    i, j = node
    for sign_x, sign_y in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        if layout.has_road(node, (i + sign_x, j)) and layout.has_road(node, (i, j + sign_y)):
            corner = layout.centre(node) + half * [sign_x, sign_y]
            angle = np.linspace(0.0, np.pi / 2, _ARC_STEPS + 1)
            arc = CORNER_M * (1 - np.stack([np.sin(angle), np.cos(angle)], axis=1))
            piece = np.concatenate([[corner], corner + arc * [sign_x, sign_y]])
            yield piece if signed_area(piece) > 0 else piece[::-1]


_ARC_STEPS = 6


def rounded_rectangle(low: ArrayLike, high: ArrayLike, radii: Sequence[float]) -> NDArray[np.float64]:
    """Polygon [n, 2], counter-clockwise from the lower left; one radius for each corner, 0 for a square one."""
    (x_low, y_low), (x_high, y_high) = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    points = []
    corners = ((x_low, y_low, 1, 1), (x_high, y_low, -1, 1), (x_high, y_high, -1, -1), (x_low, y_high, 1, -1))
    for turn, (radius_m, (x, y, sign_x, sign_y)) in enumerate(zip(radii, corners, strict=True)):
        steps = np.linspace(0.0, 1.0, _ARC_STEPS + 1) if radius_m else np.zeros(1)
        angle = np.pi * (1 + 0.5 * turn + 0.5 * steps)
        middle = np.array([x + sign_x * radius_m, y + sign_y * radius_m])
        points.append(middle + radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(points)


def clip(polygon: NDArray[np.float64], normal: tuple[int, int], bound: float) -> NDArray[np.float64]:
    """The part of a convex polygon [n, 2] with ``normal . point <= bound``."""
    height = polygon @ np.array(normal, dtype=np.float64) - bound
    points = []
    for k in range(len(polygon)):
        following = (k + 1) % len(polygon)
        if height[k] <= 0:
            points.append(polygon[k])
        if (height[k] < 0 < height[following]) or (height[following] < 0 < height[k]):
            share = height[k] / (height[k] - height[following])
            points.append(polygon[k] + share * (polygon[following] - polygon[k]))
    return np.array(points).reshape(-1, 2)


def signed_area(polygon: NDArray[np.float64]) -> float:
    """Area of a polygon [n, 2], square metres; positive where its corners run counter-clockwise."""
    x, y = polygon.T
    return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
