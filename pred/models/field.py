# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Decoder D of PRED: a BEV map makes every point of space a signed distance and class scores.

    (semantics(r), sdf(r)) = D(concat(F(r), PE(r)))                                    (PRED Eq. 3)

F(r) is the bilinear BEV feature at the point's (x, y), so the map is constant in z; PE is the cosine
positional encoding; D is an MLP with Softplus.

B frames, N points per frame, C BEV channels, H hidden width, K classes, P encoding width.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from pred.ops import sample_bev

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

    def __post_init__(self) -> None:
        for name, minimum in (("hidden", 1), ("layers", 2), ("frequencies", 0), ("num_classes", 1)):
            if getattr(self, name) < minimum:
                raise ValueError(f"FieldConfig: {name} must be at least {minimum}, got {getattr(self, name)}")
        for name in ("softplus_beta", "sdf_scale_m"):
            if not getattr(self, name) > 0:
                raise ValueError(f"FieldConfig: {name} must be positive, got {getattr(self, name)}")


class FieldOutput(NamedTuple):
    """What the field holds at the queried points."""

    sdf: Tensor
    """Signed distance `[B, N]`, metres, positive in free space."""
    semantics: Tensor | None
    """Class logits `[B, N, K]`; None where they were not asked for."""
    gradient: Tensor | None
    """d sdf / d point `[B, N, 3]`, metres per metre; None where it was not asked for."""


class FieldDecoder(nn.Module):
    """BEV-conditioned signed distance and semantics.

    The positional encoding is NeuS's, on coordinates scaled to [-1, 1] by the range box: for each
    axis n, then sin(2^k n), then cos(2^k n), k = 0 … frequencies - 1, without a factor pi. The
    output layer's first row is the signed distance in units of `sdf_scale_m`, the other K are class
    logits. Outside the range box F(r) is zero.

    Two rewritings save time and change nothing: the first layer's feature columns are applied to
    the map once (bilinear sampling is linear), and the gradient is one analytic sweep back through
    the MLP instead of `autograd.grad(create_graph=True)`.

    Initially the signed distance is positive around the centre of the range box and falls through
    zero towards its faces, whatever the map holds: see `_initialise`.

    Args:
        channels: C, channels of the BEV map.
        config: sizes.
        point_range: range box (x_min, y_min, z_min, x_max, y_max, z_max) that the map spans, metres.
    """

    range_centre_m: Tensor
    range_half_extent_m: Tensor
    frequencies: Tensor

    def __init__(
        self,
        channels: int,
        config: FieldConfig,
        point_range: tuple[float, float, float, float, float, float],
    ) -> None:
        super().__init__()
        self.channels = channels
        self.config = config
        low, high = torch.tensor(point_range, dtype=torch.float64).view(2, 3)
        # Not part of the state dict: the configuration fixes them.
        for name, value in (
            ("range_centre_m", (low + high) / 2),
            ("range_half_extent_m", (high - low) / 2),
            ("frequencies", 2.0 ** torch.arange(config.frequencies, dtype=torch.float64)),
        ):
            self.register_buffer(name, value.to(torch.get_default_dtype()), persistent=False)
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
    ) -> FieldOutput:
        """Decodes points given in metres in the map's (LiDAR) frame.

        Differentiable in the map and the parameters, the gradient output included (once: for the
        Eikonal term); in the points as far as `sdf` and `semantics` go.

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
        (first, *_), _ = self._linear_layers()
        weight = first.weight[:, : self.channels]
        return F.linear(bev.permute(0, 2, 3, 1), weight).permute(0, 3, 1, 2)

    def decode(
        self,
        projected: Tensor,  # [B, hidden, H, W]
        points_m: Tensor,  # [B, N, 3]
        with_gradient: bool = False,
        semantics: bool = True,
    ) -> FieldOutput:
        """As `forward`, from a map that `project` returned."""
        hidden_layers, output_layer = self._linear_layers()
        position = (points_m - self.range_centre_m) / self.range_half_extent_m
        encoding = self._encode(position)

        if with_gradient:
            # Sampling needs its graph for d feature / d point even where gradients are off.
            with torch.enable_grad():
                grid = position[..., :2]
                if not grid.requires_grad:
                    grid = grid.detach().requires_grad_()
                sampled = sample_bev(projected, grid)
        else:
            sampled = sample_bev(projected, position[..., :2])

        first = hidden_layers[0]
        activation = sampled + F.linear(encoding, first.weight[:, self.channels :], first.bias)
        slopes = []
        for index, layer in enumerate(hidden_layers):
            if index > 0:
                activation = F.linear(activation, layer.weight, layer.bias)
            if with_gradient:
                activation, slope = _SoftplusAndSlope.apply(activation, self.config.softplus_beta)
                slopes.append(slope)
            else:
                activation = F.softplus(activation, self.config.softplus_beta)

        rows = slice(None) if semantics else slice(1)
        output = F.linear(activation, output_layer.weight[rows], output_layer.bias[rows])
        sdf = output[..., 0] * self.config.sdf_scale_m
        return FieldOutput(
            sdf,
            output[..., 1:] if semantics else None,
            self._gradient(grid, sampled, encoding, slopes) if with_gradient else None,
        )

    def _linear_layers(self) -> tuple[list[nn.Linear], nn.Linear]:
        """Hidden layers and output layer."""
        *hidden_layers, output_layer = cast("list[nn.Linear]", list(self.layers))
        return hidden_layers, output_layer

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
        hidden_layers, output_layer = self._linear_layers()
        first = hidden_layers[0]
        octaves = (1 / self.frequencies).repeat_interleave(3)
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
        activation = torch.cat([features, self._encode(position)], dim=1)
        for layer in hidden_layers:
            activation = F.softplus(layer(activation), self.config.softplus_beta)
        sdf_m = self.range_half_extent_m.min() * (0.9 - 1.5 * position.norm(dim=1))

        inputs = F.pad(activation, (0, 1), value=1.0).double()
        normal = inputs.T @ inputs
        normal.diagonal().add_(RIDGE * normal.diagonal().mean())
        row = torch.linalg.solve(normal, inputs.T @ (sdf_m / self.config.sdf_scale_m).double())
        output_layer.weight[0] = row[:-1]
        output_layer.bias[0] = row[-1]

    def _encode(self, position: Tensor) -> Tensor:
        """Positional encoding `[..., P]` of scaled coordinates `[..., 3]`."""
        angles = (position[..., None, :] * self.frequencies[:, None]).flatten(-2)
        return torch.cat([position, angles.sin(), angles.cos()], dim=-1)

    def _gradient(
        self,
        grid: Tensor,  # [B, N, 2]
        sampled: Tensor,  # [B, N, hidden], computed from grid
        encoding: Tensor,  # [B, N, P]
        slopes: list[Tensor],  # per hidden layer [B, N, hidden]
    ) -> Tensor:
        """d sdf / d point by one sweep from the output row back to the encoding and the map."""
        hidden_layers, output_layer = self._linear_layers()
        by_activation = slopes[-1] * (output_layer.weight[0] * self.config.sdf_scale_m)
        for layer, slope in zip(hidden_layers[:0:-1], slopes[-2::-1], strict=True):
            by_activation = (by_activation @ layer.weight) * slope

        by_encoding = by_activation @ hidden_layers[0].weight[:, self.channels :]
        width = 3 * self.config.frequencies
        by_position, by_sine, by_cosine = by_encoding.split([3, width, width], dim=-1)
        _, sine, cosine = encoding.split([3, width, width], dim=-1)
        by_angle = (cosine * by_sine - sine * by_cosine).unflatten(-1, (self.config.frequencies, 3))
        by_position = by_position + (by_angle * self.frequencies[:, None]).sum(-2)

        (by_grid,) = torch.autograd.grad(sampled, grid, by_activation, create_graph=torch.is_grad_enabled())
        return (by_position + F.pad(by_grid, (0, 1))) / self.range_half_extent_m


class _SoftplusAndSlope(torch.autograd.Function):
    """Softplus and its derivative, sigmoid(beta z), with one cheap backward for both."""

    @staticmethod
    def forward(ctx: Any, activation: Tensor, beta: float) -> tuple[Tensor, Tensor]:
        slope = torch.sigmoid(activation * beta)
        ctx.save_for_backward(slope)
        ctx.beta = beta
        return F.softplus(activation, beta), slope

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_value: Tensor, grad_slope: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        # d slope / d activation = beta slope (1 - slope)
        bend = torch.addcmul(grad_slope, grad_slope, slope, value=-1).mul_(ctx.beta)
        return bend.add_(grad_value).mul_(slope), None
