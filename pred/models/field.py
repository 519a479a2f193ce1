# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Decoder D of PRED: a BEV map makes every point of space a signed distance and class scores.

    (semantics(r), sdf(r)) = D(concat(F(r), PE(r)))                                    (PRED Eq. 3)

F(r) is the bilinear BEV feature at the point's (x, y), so the map is constant in z; PE is the cosine
positional encoding; D is an MLP with Softplus.

B frames, N points per frame, C BEV channels, H hidden width, K classes, P encoding width.
"""

from dataclasses import dataclass
from typing import Literal, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pred.ops import DecodedField, decode_field
from pred.ops.decode_field import encode, project_bev

RIDGE = 1e-4
"""Relative ridge of the initial fit; it keeps the fitted weights small."""


@dataclass
class FieldConfig:
    """Sizes of the decoder."""

    hidden: int = 256
    """Width of the hidden layers."""
    layers: int = 4
    """Linear layers, the output layer included."""
    softplus_beta: float = 10.0
    """Sharpness of the Softplus; its second derivative feeds the Eikonal term."""
    frequencies: int = 6
    """Octaves of the positional encoding per axis."""
    sdf_scale_m: float = 10.0
    """Metres of signed distance per unit of network output."""
    num_classes: int = 19
    """Semantic classes K (Cityscapes train ids)."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Of the decoder's products; parameters stay float32."""
    recompute: bool = False
    """Whether the backward pass computes activations again in place of keeping them."""

    def __post_init__(self) -> None:
        for name, minimum in (("hidden", 1), ("layers", 2), ("frequencies", 0), ("num_classes", 1)):
            if getattr(self, name) < minimum:
                raise ValueError(f"FieldConfig: {name} must be at least {minimum}, got {getattr(self, name)}")
        for name in ("softplus_beta", "sdf_scale_m"):
            if not getattr(self, name) > 0:
                raise ValueError(f"FieldConfig: {name} must be positive, got {getattr(self, name)}")


class FieldDecoder(nn.Module):
    """BEV-conditioned signed distance and semantics.

    The positional encoding is NeuS's, on coordinates scaled to [-1, 1] by the range box: for each
    axis n, then sin(2^k n), then cos(2^k n), k = 0 … frequencies - 1, without a factor pi. The
    output layer's first row is the signed distance in units of `sdf_scale_m`, the other K are class
    logits. Outside the range box F(r) is zero.

    `pred.ops.decode_field` does the work: compiled, or in plain PyTorch where `PRED_BACKEND` says so.

    Initially the signed distance is positive around the centre of the range box and falls through
    zero towards its faces, whatever the map holds: see `_initialise`.

    Args:
        channels: C, channels of the BEV map.
        config: sizes.
        point_range: range box (x_min, y_min, z_min, x_max, y_max, z_max) that the map spans, metres.
    """

    def __init__(
        self,
        channels: int,
        config: FieldConfig,
        point_range: tuple[float, float, float, float, float, float],
    ) -> None:
        super().__init__()
        self.channels = channels
        self.config = config
        self.point_range = point_range
        encoding_width = 3 + 6 * config.frequencies
        widths = [channels + encoding_width] + [config.hidden] * (config.layers - 1)
        widths.append(1 + config.num_classes)
        self.layers = nn.ModuleList(nn.Linear(before, after) for before, after in zip(widths, widths[1:], strict=False))
        self._initialise()

    def forward(
        self,
        bev: Tensor,  # [B, C, H, W]
        points_m: Tensor,  # [B, N, 3]
        with_gradient: bool = False,
        semantics: bool = True,
    ) -> DecodedField:
        """Decodes points given in metres in the map's (LiDAR) frame.

        Differentiable once in the map, the points and the parameters, the gradient output included.

        Args:
            bev: BEV map, row = y, column = x, spanning the range box.
            points_m: points in metres.
            with_gradient: also return d sdf / d point.
            semantics: False skips the class logits.
        """
        return self.decode(self.project(bev), points_m, with_gradient, semantics)

    def project(self, bev: Tensor) -> Tensor:
        """First layer's share of the map: `[B, C, H, W]` to `[B, hidden, H, W]`.

        Callers that decode several sets of points from one map do this once.
        """
        return project_bev(bev, self._linear_layers()[0].weight, self.config.precision)

    def decode(
        self,
        projected: Tensor,  # [B, hidden, H, W]
        points_m: Tensor,  # [B, N, 3]
        with_gradient: bool = False,
        semantics: bool = True,
    ) -> DecodedField:
        """As `forward`, from a map that `project` returned."""
        weights: list[Tensor] = [layer.weight for layer in self._linear_layers()]
        biases: list[Tensor] = [layer.bias for layer in self._linear_layers()]
        if not semantics:
            weights[-1], biases[-1] = weights[-1][:1], biases[-1][:1]
        return decode_field(
            projected,
            points_m,
            weights,
            biases,
            self.point_range,
            frequencies=self.config.frequencies,
            softplus_beta=self.config.softplus_beta,
            sdf_scale=self.config.sdf_scale_m,
            with_gradient=with_gradient,
            projected=True,
            precision=self.config.precision,
            recompute=self.config.recompute,
        )

    def _linear_layers(self) -> list[nn.Linear]:
        return cast("list[nn.Linear]", list(self.layers))

    @torch.no_grad()
    def _initialise(self) -> None:
        """Draws the weights and fits the output layer's first row to an inside-out ellipsoid.

        Where the signed distance rises along a ray, the pair opacity of PRED is 0 and so is its
        derivative: a ray that starts transparent learns nothing from depth. So the first field is
        h (0.9 - 1.5 |n|), with n the coordinates scaled to [-1, 1] and h the box's smallest half
        extent in metres: positive around the centre, where sensors are, zero at |n| = 0.6 and
        negative at every face. Each ray from near the centre then ends almost opaque, most of them
        with weights spread over many metres.

        The hidden layers are drawn such that the activations are of order one everywhere in the box
        (He); octave k of the encoding starts with weights 2^-k, that is, every octave with the same
        slope, and the features of the untrained encoder start weak. The row is a ridge regression
        on the activations at random points under random features, so the map has little say in it.
        """
        *hidden_layers, output_layer = self._linear_layers()
        first = hidden_layers[0]
        octaves = 0.5 ** torch.arange(self.config.frequencies).repeat_interleave(3)
        first.weight[:, : self.channels].normal_(0, 0.1 * self.channels**-0.5)
        first.weight[:, self.channels :].normal_().mul_(torch.cat([torch.ones(3), octaves, octaves]))
        first.bias.uniform_(-1, 1)
        for layer in hidden_layers[1:]:
            layer.weight.normal_(0, (2 / layer.in_features) ** 0.5)
            layer.bias.uniform_(-0.1, 0.1)

        num_points = 16 * self.config.hidden + 4096
        position = 2 * torch.rand(num_points, 3) - 1
        position[::2] *= torch.rand(num_points // 2, 1)  # half of them nearer to the centre
        features = torch.randn(num_points, self.channels).relu()  # as a batch norm and ReLU give
        activation = torch.cat([features, encode(position, self.config.frequencies)], dim=1)
        for layer in hidden_layers:
            activation = F.softplus(layer(activation), self.config.softplus_beta)
        low, high = torch.tensor(self.point_range).view(2, 3)
        half_extent_m = (high - low).min() / 2
        sdf_m = half_extent_m * (0.9 - 1.5 * position.norm(dim=1))

        inputs = F.pad(activation, (0, 1), value=1.0).double()
        normal = inputs.T @ inputs
        normal.diagonal().add_(RIDGE * normal.diagonal().mean())
        row = torch.linalg.solve(normal, inputs.T @ (sdf_m / self.config.sdf_scale_m).double())
        output_layer.weight[0] = row[:-1]
        output_layer.bias[0] = row[-1]
