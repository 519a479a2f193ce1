# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Procedural worlds seen by a LiDAR and six cameras, with exact semantics.

`Drive` is a drive through a town with traffic. `meshes` are primitives; `objects` and `vehicles` what they are
assembled to. Of a town, `town` is the plan, `lanes` and `traffic` how vehicles move, `population` who is there,
`actors` what has an annotation, `blocks` what has none. `scene` and `moment` cast rays, `sensors` are the LiDAR and the
cameras.
"""

from pred.data.world.actors import Actor
from pred.data.world.drive import CATEGORIES, Drive, Sweep, View
from pred.data.world.town import TownMap

__all__ = ["CATEGORIES", "Actor", "Drive", "Sweep", "TownMap", "View"]
