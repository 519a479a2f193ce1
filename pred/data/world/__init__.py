# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The embedded default data: procedural streets seen by a LiDAR and six cameras, with exact semantics.

`meshes` are primitives, `objects` what they are assembled to, `street` the layout, `scene` the ray caster, `sensors`
the LiDAR and the cameras, `frames` the `FrameSource` on top.
"""

from pred.data.world.frames import StreetConfig, StreetFrames

__all__ = ["StreetConfig", "StreetFrames"]
