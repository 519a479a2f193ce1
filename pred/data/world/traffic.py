# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Vehicles that follow their routes: car-following on lanes, one approach at a time across junctions.

The longitudinal model is the intelligent driver model (Treiber, Hennecke, Helbing: "Congested traffic states in
empirical observations and microscopic simulations", Phys. Rev. E 62, 2000).
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pred.data.world.lanes import Route
from pred.data.world.motion import Profile
from pred.data.world.town import Layout, Node

STEP_S = 0.1
ACCELERATION_MPS2, BRAKING_MPS2, HARDEST_MPS2 = 2.2, 3.0, 6.0
STANDING_GAP_M, HEADWAY_S = 2.0, 1.1
LOOK_AHEAD_M = 50.0
NEAR_CLEAR_S, FAR_CLEAR_S = 4.0, (1.5, 8.0)
"""When zebra crossings must stay free: seconds from entering a junction, on its near and its far side."""
PATIENCE_S = 4.0
"""Vehicles let the cars behind one another pass for that long before it is their turn."""

Crossings = dict[tuple[Node, Node, bool], list[tuple[float, float]]]
"""(node that the stretch comes from, node at the crossing, whether on the half of the road that leads to that node)
-> seconds during which somebody walks there."""


@dataclass
class Driver:
    """A vehicle (or a lorry with its trailer) before the simulation.

    Attributes:
        route: where it goes.
        length_m: from its front to its end.
        front_m: of its front on the route, at least ``length_m``.
        desired_mps: speed on a free road.
        hold_s: how long it stands before its first junction at least.
        has_priority: other approaches of the junction ahead of it wait, at the first from when it nearly stands on.
    """

    route: Route
    length_m: float
    front_m: float
    desired_mps: float
    hold_s: float = 0.0
    has_priority: bool = False


class _State:
    """A driver during the simulation."""

    def __init__(self, driver: Driver) -> None:
        route = driver.route
        self.driver = driver
        self.sections = route.sections
        self.starts = route.starts_m.tolist()
        self.limit = route.speed_limit_mps.tolist()
        self.front = driver.front_m
        self.section = int(np.searchsorted(route.starts_m, driver.front_m, side="right")) - 1
        self.speed = min(driver.desired_mps, self.limit[int(self.front)])
        self.granted = 0
        self.hold_s = driver.hold_s
        self.asked_s: float | None = None
        self.held: Node | None = None

    def advance(self, acceleration: float) -> None:
        self.front += self.speed * STEP_S + 0.5 * acceleration * STEP_S**2
        self.speed = max(self.speed + acceleration * STEP_S, 0.0)
        while self.section + 1 < len(self.sections) and self.front >= self.starts[self.section + 1]:
            self.section += 1

    def acceleration(self, gap: float, speed_ahead: float) -> float:
        """Of the intelligent driver model."""
        desired = min(self.driver.desired_mps, self.limit[min(int(self.front), len(self.limit) - 1)])
        free = 1.0 - (self.speed / desired) ** 4
        closing = self.speed * (self.speed - speed_ahead) / (2 * (ACCELERATION_MPS2 * BRAKING_MPS2) ** 0.5)
        wanted = STANDING_GAP_M + max(self.speed * HEADWAY_S + closing, 0.0)
        value = ACCELERATION_MPS2 * (max(free, -1.5) - (wanted / max(gap, 0.1)) ** 2)
        # No reversing: at most what brings it to rest within the step.
        return max(min(value, ACCELERATION_MPS2), -HARDEST_MPS2, -self.speed / STEP_S)


_Occupants = dict[tuple[str, Node, Node, Node, int], list[tuple[float, float, "_State"]]]


def simulate(
    drivers: list[Driver], layout: Layout, crossings: Crossings, start_us: int, duration_s: float
) -> list[Profile]:
    """Motion of all drivers from ``start_us`` on."""
    states = [_State(driver) for driver in drivers]
    steps = int(np.ceil(duration_s / STEP_S)) + 1
    record: NDArray[np.float64] = np.zeros((len(states), 3, steps))
    for step in range(steps):
        occupants = _occupants(states)
        _release(states)
        _grant(states, occupants, layout, crossings, step * STEP_S)
        accelerations = []
        for index, state in enumerate(states):
            acceleration = state.acceleration(*_ahead(state, occupants, layout))
            accelerations.append(acceleration)
            record[index, :, step] = state.front, state.speed, acceleration
        for state, acceleration in zip(states, accelerations, strict=True):
            state.advance(acceleration)
    knots_s = STEP_S * np.arange(steps, dtype=np.float64)
    return [Profile(start_us, knots_s, *record[index]) for index in range(len(states))]


def _occupants(states: list[_State]) -> _Occupants:
    """Who is on each section: rear and front, metres from the section's start."""
    found: _Occupants = defaultdict(list)
    for state in states:
        rear, section = state.front - state.driver.length_m, state.section
        while section >= 0:
            start = state.starts[section]
            found[state.sections[section].key].append((rear - start, state.front - start, state))
            if rear >= start:
                break
            section -= 1
    return found


def _ahead(state: _State, occupants: _Occupants, layout: Layout) -> tuple[float, float]:
    """Gap to what is ahead, a vehicle or a stop line, and its speed."""
    gap, speed = 1e3, state.speed
    section = state.section
    while section < len(state.sections) and state.starts[section] - state.front < LOOK_AHEAD_M:
        start = state.starts[section]
        piece = state.sections[section]
        if section > state.section and section > state.granted and _is_guarded(state, section, layout):
            to_line = start + STANDING_GAP_M - 1.0 - state.front
            return (to_line, 0.0) if to_line < gap else (gap, speed)
        for rear, front, other in occupants.get(piece.key, ()):
            if other is not state and start + front > state.front and start + rear - state.front < gap:
                gap, speed = start + rear - state.front, other.speed
        section += 1
    return gap, speed


def _is_guarded(state: _State, section: int, layout: Layout) -> bool:
    node = state.sections[section].node
    return node is not None and layout.is_junction(node)


def _release(states: list[_State]) -> None:
    for state in states:
        if state.held is not None and state.front - state.driver.length_m > state.starts[state.granted + 1]:
            state.held = None


class _Request(NamedTuple):
    """Somebody who wants to enter a junction, in the order in which they are answered."""

    asked_s: float
    order: int
    state: _State
    node: Node
    approach: Node


def _grant(states: list[_State], occupants: _Occupants, layout: Layout, crossings: Crossings, time_s: float) -> None:
    """Let vehicles into junctions, those first that have asked first."""
    requests, preferred = _requests(states, occupants, layout, time_s)
    for request in requests:
        state, node = request.state, request.node
        if preferred.get(node, request.approach) != request.approach:
            continue
        holders = [other for other in states if other.held == node]
        if any(other.sections[other.granted].approach != request.approach for other in holders):
            continue
        overdue = any(
            other.node == node and other.approach != request.approach and time_s - other.asked_s > PATIENCE_S
            for other in requests
        )
        if holders and overdue and time_s - request.asked_s <= PATIENCE_S:
            continue
        if _has_way(state, occupants, crossings, time_s):
            state.granted, state.held, state.asked_s = state.section + 1, node, None


def _requests(
    states: list[_State], occupants: _Occupants, layout: Layout, time_s: float
) -> tuple[list[_Request], dict[Node, Node]]:
    """Who wants to enter a junction now, and by junction the approach of a driver with priority."""
    requests, preferred = [], {}
    for order, state in enumerate(states):
        following = state.section + 1
        if following >= len(state.sections) or following <= state.granted or not _is_guarded(state, following, layout):
            continue
        node, approach = state.sections[following].node, state.sections[following].approach
        assert node is not None
        distance = state.starts[following] - state.front
        if state.driver.has_priority and distance < LOOK_AHEAD_M and (state.hold_s <= 0 or state.speed < 3.0):
            preferred[node] = approach
        if state.hold_s > 0:
            # The first stop of somebody who has to stop: time runs once it stands.
            if state.speed < 0.3:
                state.hold_s -= STEP_S
            continue
        # Nobody asks from behind somebody who has not been let in yet.
        offset = state.front - state.starts[state.section]
        on_lane = occupants.get(state.sections[state.section].key, ())
        is_first = all(front <= offset or other.held == node for _, front, other in on_lane)
        if is_first and distance < state.speed**2 / (2 * BRAKING_MPS2) + 12.0:
            state.asked_s = time_s if state.asked_s is None else state.asked_s
            requests.append(_Request(state.asked_s, order, state, node, approach))
    return sorted(requests, key=lambda request: (request.asked_s, request.order)), preferred


def _has_way(state: _State, occupants: _Occupants, crossings: Crossings, time_s: float) -> bool:
    """Whether nobody is about to walk where it would drive, and there is room behind the junction."""
    section, leaving = state.sections[state.section + 1], state.sections[state.section + 2]
    _, approach, node, after, _ = section.key
    # The crossing on this side is passed at once, the one on the other side some seconds later.
    for zebra, from_s, until_s in (
        ((approach, node, True), 0.0, NEAR_CLEAR_S),
        ((after, node, False), *FAR_CLEAR_S),
    ):
        if any(begin < time_s + until_s and time_s + from_s < end for begin, end in crossings.get(zebra, ())):
            return False
    needed_m = state.driver.length_m + 3.0
    return not any(rear < needed_m and other.speed < 2.5 for rear, _, other in occupants.get(leaving.key, ()))
