# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Encoder weights in the names and layouts of other frameworks: tables and pure functions on state dicts.

A state dict of an encoder here has OpenPCDet's names (``vfe.…``, ``backbone_3d.…``, ``backbone_2d.…``), and its sparse
kernels are stored as spconv 2 does, KRSC = (out, z, y, x, in). `layout` lists for every tensor what becomes of it in a
framework; `export_state` and `import_state` carry that list out. Both are strict: a tensor without a place, of another
type or not finite is an error that names it, and on import one that is missing, left over or of another shape.

Sparse kernels are written DHWIO = (z, y, x, in, out), without version metadata: OpenPCDet and DSVT turn them on loading
because the shape differs from the model's, mmdetection3d (with spconv 2 and with mmcv's own operators) expects them.

mmdetection3d differs from OpenPCDet in names; in its residual sparse blocks, whose convolutions have no bias (a bias
before batch normalisation is the same as a smaller running mean: ``running_mean - bias``); in the 2D blocks, which have
no padding layer at index 0; and, where ``use_conv_for_no_stride=True``, in the deblocks of stride 1, which are a
Conv2d [out, in, 1, 1] in place of a ConvTranspose2d [in, out, 1, 1].
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

Framework = Literal["openpcdet", "dsvt", "mmdet3d"]
FRAMEWORKS: tuple[Framework, ...] = ("openpcdet", "dsvt", "mmdet3d")
WRAPPERS: dict[Framework, str] = {"openpcdet": "model_state", "dsvt": "model_state", "mmdet3d": "state_dict"}
"""Key of the checkpoint's dictionary under which the framework looks for the weights."""

ENCODER_MODULES = ("vfe", "backbone_3d", "backbone_2d")
"""Modules of an encoder in OpenPCDet, DSVT and here."""
MMDET3D_MODULES = ("voxel_encoder", "middle_encoder", "backbone", "neck")
"""The same in mmdetection3d; CenterPoint and MVXNet put ``pts_`` before each."""

KernelOrder = Literal["krsc", "dhwio"]
KRSC_TO_DHWIO = (1, 2, 3, 4, 0)
SWAP_CHANNELS = (1, 0, 2, 3)

Shape = tuple[int, ...]
Shapes = dict[str, Shape]

NAMED = 12
"""Names listed in full in an error; of more, the rest is counted."""


class LayoutError(ValueError):
    """A state dict does not fit the layout that it is read or written in."""


@dataclass(frozen=True)
class LayoutOptions:
    """What differs between the configurations of one framework. None: as in its own for the encoder's kind."""

    stride1_conv: bool | None = None
    """Deblocks of stride 1 are a Conv2d [out, in, 1, 1] in place of a ConvTranspose2d [in, out, 1, 1]:
    USE_CONV_FOR_NO_STRIDE of BaseBEVBackbone (default: as the encoder here), `use_conv_for_no_stride` of SECONDFPN
    (default: True for pillars and voxels, as in the nuScenes CenterPoint configurations; False for DSVT, as in
    projects/DSVT)."""
    prefix: Literal["pts_", ""] | None = None
    """mmdetection3d: before the modules' names, ``pts_`` (CenterPoint; default for pillars and voxels) or nothing
    (VoxelNet, and projects/DSVT; default for DSVT)."""
    dynamic_pillars: bool = False
    """mmdetection3d: the names of DynamicPillarFeatureNet in place of those of PillarFeatureNet."""

    def resolved(self, shapes: Shapes, framework: Framework, conv_here: bool) -> LayoutOptions:
        """Without None where it matters to the framework.

        Args:
            shapes: names and shapes of the encoder here.
            framework: that the options are for.
            conv_here: deblocks of stride 1 are a Conv2d here.
        """
        if framework != "mmdet3d":
            if self.prefix is not None or self.dynamic_pillars:
                raise LayoutError(f"{framework}: prefix and dynamic_pillars must be left out, they are mmdetection3d's")
            return LayoutOptions(stride1_conv=conv_here if self.stride1_conv is None else self.stride1_conv)
        is_dsvt = kind_of(shapes) == "dsvt"
        if kind_of(shapes) != "pillars" and self.dynamic_pillars:
            raise LayoutError(
                "mmdet3d: dynamic_pillars must be left out for DSVT, whose project has a pillar network of its own"
                if is_dsvt
                else "mmdet3d: dynamic_pillars must be left out for voxels, which have no pillar network"
            )
        return LayoutOptions(
            stride1_conv=self.stride1_conv if self.stride1_conv is not None else not is_dsvt,
            prefix=self.prefix if self.prefix is not None else "" if is_dsvt else "pts_",
            dynamic_pillars=self.dynamic_pillars,
        )


class Entry(NamedTuple):
    """What becomes of one tensor."""

    ours: str
    """Its name here."""
    theirs: str
    """Its name there."""
    shape: Shape
    """Its shape here."""
    axes: tuple[int, ...] | None
    """Their axis i is our axis axes[i]; None: as they are."""
    minus: str | None
    """Name here of a bias that is subtracted from it, and does not exist there."""

    @property
    def their_shape(self) -> Shape:
        return self.shape if self.axes is None else tuple(self.shape[axis] for axis in self.axes)


def kind_of(names: Collection[str]) -> Literal["pillars", "voxels", "dsvt"]:
    """The family of encoder that has these names."""
    if any(name.startswith("backbone_3d.input_layer.") for name in names):
        return "dsvt"
    return "voxels" if any(name.startswith("backbone_3d.") for name in names) else "pillars"


def shapes_of(state: Mapping[str, Tensor]) -> Shapes:
    return {name: tuple(tensor.shape) for name, tensor in state.items()}


def layout(shapes: Shapes, to: Framework, options: LayoutOptions | None = None, conv_here: bool = False) -> list[Entry]:
    """What becomes of each tensor of an encoder.

    Args:
        shapes: names and shapes here.
        to: framework.
        options: of its configuration.
        conv_here: deblocks of stride 1 are a Conv2d here (`BEVBackboneConfig.conv_for_no_stride`).

    Raises:
        LayoutError: the framework has no place for a tensor, or would read it wrongly; the text names it.
    """
    options = (options or LayoutOptions()).resolved(shapes, to, conv_here)
    rename: Callable[[str], str | None] = _openpcdet_names
    folded: dict[str, str] = {}
    if to == "mmdet3d":
        rename = _mmdet3d_names(shapes, options)
        folded = _folded_biases(shapes)
    entries, unknown = [], []
    for ours, shape in shapes.items():
        if ours in folded.values():
            continue
        theirs = rename(ours)
        if theirs is None:
            unknown.append(ours)
            continue
        axes: tuple[int, ...] | None = None
        if is_sparse_kernel(ours, shape):
            axes = KRSC_TO_DHWIO
        elif options.stride1_conv != conv_here and is_stride1_deblock(ours, shape):
            axes = SWAP_CHANNELS
        entries.append(Entry(ours, theirs, shape, axes, folded.get(ours)))
    if unknown:
        raise LayoutError(f"{to}: every tensor must have a place in the framework, got none for {_list(unknown)}")
    if to != "mmdet3d":
        _refuse_kernels_turned_wrongly(entries, to)
    theirs_of = [entry.theirs for entry in entries]
    assert len(set(theirs_of)) == len(theirs_of), "two tensors under one name"
    return entries


def export_state(
    state: Mapping[str, Tensor], to: Framework, options: LayoutOptions | None = None, conv_here: bool = False
) -> dict[str, Tensor]:
    """An encoder's state dict as a framework loads it: plain dictionary of contiguous tensors, float32 and int64.

    The arguments are those of `layout`.

    Raises:
        LayoutError: a tensor has no place in the framework, is of another type than the framework's or not finite.
    """
    entries = layout(shapes_of(state), to, options, conv_here)
    _require_usable(state)
    exported = {}
    for entry in entries:
        tensor = state[entry.ours].detach().cpu()
        if entry.minus is not None:
            tensor = tensor - state[entry.minus].detach().cpu()
        if tensor.is_floating_point():
            tensor = tensor.float()
        if entry.axes is not None:
            tensor = tensor.permute(entry.axes)
        exported[entry.theirs] = tensor.clone(memory_format=torch.contiguous_format)
    return exported


def import_state(
    state: Mapping[str, Tensor],
    shapes: Shapes,
    source: Framework,
    options: LayoutOptions | None = None,
    kernel_order: KernelOrder | None = None,
    conv_here: bool = False,
) -> dict[str, Tensor]:
    """The inverse of `export_state`: the encoder part of a framework's state dict, with the names and layouts here.

    Args:
        state: encoder part alone.
        shapes: names and shapes of the encoder that it is for.
        source: framework that it comes from.
        options: of its configuration; for mmdetection3d a prefix of None is read from the names, and ``stride1_conv``
            of None from the shapes.
        kernel_order: of sparse kernels; None reads it from the shapes.
        conv_here: deblocks of stride 1 are a Conv2d here.

    Raises:
        LayoutError: a tensor is missing, left over, of another shape or type, or not finite; the order of the kernels
            cannot be told; or the inverse is not exact, as biases were folded away.
    """
    if source == "mmdet3d":
        options = _options_of_file(state, shapes, options or LayoutOptions(), conv_here)
    entries = layout(shapes, source, options, conv_here)
    folded = [entry.minus for entry in entries if entry.minus is not None]
    if folded:
        raise LayoutError(
            f"{source}: the encoder's residual convolutions must have no bias, as those of {source}, got "
            f"{_list(folded)}; choose an encoder without them"
        )
    order = kernel_order or find_kernel_order(shapes_of(state), entries)
    wanted = {}
    for entry in entries:
        axes = entry.axes
        if axes == KRSC_TO_DHWIO and order == "krsc":
            axes = None
        wanted[entry.theirs] = entry._replace(axes=axes)
    differences = explain_differences(shapes_of(state), {name: entry.their_shape for name, entry in wanted.items()})
    if differences:
        rest = [f"  and {len(differences) - NAMED} more"] if len(differences) > NAMED else []
        lines = "\n".join([*differences[:NAMED], *rest])
        raise LayoutError(f"{source}: tensors must be those of the encoder, got\n{lines}")
    _require_usable(state)
    imported = {}
    for theirs, entry in wanted.items():
        tensor = state[theirs].detach().cpu()
        if tensor.is_floating_point():
            tensor = tensor.float()
        if entry.axes is not None:
            tensor = tensor.permute(_inverse(entry.axes))
        imported[entry.ours] = tensor.clone(memory_format=torch.contiguous_format)
    return imported


def find_kernel_order(found: Shapes, entries: list[Entry]) -> KernelOrder:
    """Order of a file's sparse kernels, from their shapes.

    A kernel tells the order unless (out, z, y, x, in) and (z, y, x, in, out) are the same numbers, as for 3 channels
    in, 3 out and edges of 3. All kernels of a file have one order, so one that tells it is enough.

    Raises:
        LayoutError: no kernel tells it.
    """
    orders: set[KernelOrder] = set()
    kernels = [entry for entry in entries if entry.axes == KRSC_TO_DHWIO]
    for entry in kernels:
        shape = found.get(entry.theirs)
        if shape is None or entry.shape == entry.their_shape:
            continue
        if shape == entry.shape:
            orders.add("krsc")
        elif shape == entry.their_shape:
            orders.add("dhwio")
        elif sorted(shape) == sorted(entry.shape):
            raise LayoutError(
                f"{entry.theirs}: sparse kernel must be (out, z, y, x, in) = {entry.shape} or (z, y, x, in, out) = "
                f"{entry.their_shape}, got {shape}"
            )
    if len(orders) == 2:
        raise LayoutError("sparse kernels must have one order, got (out, z, y, x, in) and (z, y, x, in, out) in a file")
    if orders:
        return orders.pop()
    if any(entry.theirs in found and entry.shape == entry.their_shape for entry in kernels):
        raise LayoutError(
            "sparse kernels must show by their shapes whether they are (out, z, y, x, in) or (z, y, x, in, out), got "
            "none that does; say it with --kernel-order"
        )
    return "krsc"  # no kernels at all, or none of a shape that fits: the comparison of shapes will say so


def explain_differences(found: Shapes, wanted: Shapes) -> list[str]:
    """A line for each tensor that is missing, left over or of another shape, with the probable cause; the first line
    is a cause that all of them share, if there is one."""
    lines = []
    shared = shared_cause(found, wanted)
    if shared:
        lines.append(f"  {shared}")
    missing = [name for name in wanted if name not in found]
    extra = [name for name in found if name not in wanted]
    for name in missing:
        lines.append(f"  missing   {name} {_text(wanted[name])}{cause_of_missing(name, found)}")
    for name in extra:
        lines.append(f"  left over {name} {_text(found[name])}{cause_of_extra(name, wanted)}")
    for name in wanted:
        if name in found and found[name] != wanted[name]:
            cause = cause_of_shape(name, found[name], wanted[name])
            lines.append(f"  shape     {name} must be {_text(wanted[name])}, got {_text(found[name])}{cause}")
    return lines


def shared_cause(found: Shapes, wanted: Shapes) -> str | None:
    """Why hardly any name of a file is one of the model's: a prefix too many or too few, or another framework."""
    same = len(found.keys() & wanted.keys())
    best, cause = same, None
    for prefix in sorted({part for name in found for part in _prefixes(name)}, key=len):
        stripped = {name.removeprefix(prefix) for name in found if name.startswith(prefix)}
        if len(stripped & wanted.keys()) > best:
            best, cause = (
                len(stripped & wanted.keys()),
                f"probable cause: the file's names have a prefix '{prefix}' too many",
            )
    for prefix in sorted({part for name in wanted for part in _prefixes(name)}, key=len):
        added = {prefix + name for name in found}
        if len(added & wanted.keys()) > best:
            best, cause = len(added & wanted.keys()), f"probable cause: the file's names lack the prefix '{prefix}'"
    if cause is None and same == 0 and found and wanted:
        frameworks = framework_of(found), framework_of(wanted)
        if frameworks[0] != frameworks[1] and None not in frameworks:
            cause = f"probable cause: the file has {frameworks[0]}'s names, the model {frameworks[1]}'s"
    return cause


def _prefixes(name: str) -> list[str]:
    """``pts_`` and whatever ends with a dot."""
    dots = [name[: match.end()] for match in re.finditer(r"\.", name)]
    return [*dots, *(f"{dot}pts_" for dot in ["", *dots] if name.startswith(f"{dot}pts_"))]


def framework_of(names: Collection[str]) -> str | None:
    """ "OpenPCDet" (names of DSVT and of this package too) or "mmdetection3d", by the modules; None: neither. The
    modules may stand behind one more, such as ``module.``."""
    for depth in (0, 1):
        modules = {part for name in names for part in name.split(".")[depth : depth + 1]}
        if modules & {*ENCODER_MODULES}:
            return "OpenPCDet"
        if modules & {*MMDET3D_MODULES, *(f"pts_{module}" for module in MMDET3D_MODULES)}:
            return "mmdetection3d"
    return None


def cause_of_missing(name: str, found: Collection[str]) -> str:
    """Probable cause, after a colon, or nothing."""
    if re.search(r"\.conv[12]\.bias$", name) and name.removesuffix("bias") + "weight" in found:
        return ": the file's residual convolutions have no bias (USE_BIAS: False), or it was folded into running_mean"
    if name.endswith(".num_batches_tracked") and name.removesuffix("num_batches_tracked") + "running_mean" in found:
        return ": written by torch before 0.4.1, or stripped"
    module = name.split(".")[0]
    if not any(other.startswith(f"{module}.") for other in found):
        return f": the file holds nothing of {module}"
    return ""


def cause_of_extra(name: str, wanted: Collection[str]) -> str:
    """Probable cause, after a colon, or nothing."""
    if re.search(r"\.conv[12]\.bias$", name) and name.removesuffix("bias") + "weight" in wanted:
        return ": the model's residual convolutions have no bias (USE_BIAS: False, mmdetection3d)"
    module = name.split(".")[0]
    if not any(other.startswith(f"{module}.") for other in wanted):
        return f": the model has no {module}"
    return ""


def cause_of_shape(name: str, found: Shape, wanted: Shape) -> str:
    """Probable cause, after a colon, or nothing."""
    if len(found) == len(wanted) == 5:
        return _cause_of_kernel_shape(name, found, wanted)
    if name.endswith(_FIRST_LINEAR) and found[0] == wanted[0]:
        return f": the file is for points of {found[1] - 6} channels, the model for {wanted[1] - 6}"
    if len(found) == len(wanted) == 4:
        if _BLOCK_INPUT.search(name) and found[0] == wanted[0] and found[2:] == wanted[2:]:
            return (
                ": the channels that enter the 2D backbone differ; after a sparse backbone they are its channels times "
                "the cells left in z, which follow from the voxel size and the range in z"
            )
        if found == tuple(wanted[axis] for axis in SWAP_CHANNELS):
            return ": a ConvTranspose2d [in, out, k, k] in place of a Conv2d [out, in, k, k], or the other way round"
        if found[2:] != wanted[2:]:
            return ": kernels of other sizes, so another stride"
    return ": layers of other widths"


def _cause_of_kernel_shape(name: str, found: Shape, wanted: Shape) -> str:
    if found == tuple(wanted[axis] for axis in KRSC_TO_DHWIO):
        return ": (z, y, x, in, out) in place of (out, z, y, x, in)"
    if wanted == tuple(found[axis] for axis in KRSC_TO_DHWIO):
        return ": (out, z, y, x, in) in place of (z, y, x, in, out)"
    if "conv_input." in name:
        channels = [shape[-1] if shape[0] == 16 else shape[-2] for shape in (found, wanted)]
        if channels[0] != channels[1]:
            return f": the file is for points of {channels[0]} channels, the model for {channels[1]}"
    return ": layers of other widths"


_FIRST_LINEAR = ("pfn_layers.0.linear.weight", "pfn_layers.0.0.weight")
_BLOCK_INPUT = re.compile(r"backbone(_2d)?\.blocks\.0\.(0|1|0\.conv1|0\.downsample_layer\.0)\.weight$")


def is_sparse_kernel(name: str, shape: Shape) -> bool:
    """Whether a tensor of an encoder is the kernel of a sparse 3D convolution."""
    return len(shape) == 5


def is_stride1_deblock(name: str, shape: Shape) -> bool:
    """Whether a tensor is the kernel of an upsampling layer of stride 1: these kernels are as wide as their stride."""
    return re.search(r"\bdeblocks\.\d+\.0\.weight$", name) is not None and shape[2:] == (1, 1)


def _openpcdet_names(name: str) -> str | None:
    return name if name.split(".")[0] in ENCODER_MODULES else None


def _mmdet3d_names(shapes: Shapes, options: LayoutOptions) -> Callable[[str], str | None]:
    vfe, middle, backbone, neck = (f"{options.prefix}{module}" for module in MMDET3D_MODULES)
    rules: list[tuple[str, Callable[[re.Match[str]], str]]] = [
        (r"backbone_2d\.(deblocks\.\d+\.[01]\..+)", lambda found: f"{neck}.{found[1]}"),
        # Residual blocks, as ResSECOND has them.
        (
            r"backbone_2d\.(blocks\.\d+\.\d+\.(?:conv[12]|bn[12]|downsample_layer\.[01])\..+)",
            lambda found: f"{backbone}.{found[1]}",
        ),
        # SECOND has no padding layer at index 0.
        (
            r"backbone_2d\.blocks\.(\d+)\.([1-9]\d*)\.(\w+)",
            lambda found: f"{backbone}.blocks.{found[1]}.{int(found[2]) - 1}.{found[3]}",
        ),
    ]
    if options.dynamic_pillars:
        index = {"linear": 0, "norm": 1}
        rules += [
            (
                r"vfe\.pfn_layers\.(\d+)\.(linear|norm)\.(\w+)",
                lambda found: f"{vfe}.pfn_layers.{found[1]}.{index[found[2]]}.{found[3]}",
            )
        ]
    else:
        rules += [(r"vfe\.(pfn_layers\.\d+\.(?:linear|norm)\.\w+)", lambda found: f"{vfe}.{found[1]}")]
    layers = f"{middle}.encoder_layers.encoder_layer"
    if kind_of(shapes) == "dsvt":
        rules += [
            (
                r"backbone_3d\.((?:input_layer|stage_\d|residual_norm_stage_\d)\..+)",
                lambda found: f"{middle}.{found[1]}",
            )
        ]
    elif any(name.startswith("backbone_3d.conv1.0.conv1.") for name in shapes):
        # A stage here is its strided convolution and two blocks; there, two blocks and the next stage's convolution.
        rules += [
            (r"backbone_3d\.(conv_(?:input|out)\.[01]\.\w+)", lambda found: f"{middle}.{found[1]}"),
            (r"backbone_3d\.conv1\.([01])\.((?:conv|bn)[12]\.\w+)", lambda found: f"{layers}1.{found[1]}.{found[2]}"),
            (r"backbone_3d\.conv([234])\.0\.([01]\.\w+)", lambda found: f"{layers}{int(found[1]) - 1}.2.{found[2]}"),
            (
                r"backbone_3d\.conv([234])\.([12])\.((?:conv|bn)[12]\.\w+)",
                lambda found: f"{layers}{found[1]}.{int(found[2]) - 1}.{found[3]}",
            ),
        ]
    else:
        rules += [
            (r"backbone_3d\.(conv_(?:input|out)\.[01]\.\w+)", lambda found: f"{middle}.{found[1]}"),
            (
                r"backbone_3d\.conv([1-4])\.([012])\.([01]\.\w+)",
                lambda found: f"{layers}{found[1]}.{found[2]}.{found[3]}",
            ),
        ]

    def rename(name: str) -> str | None:
        for pattern, replacement in rules:
            found = re.fullmatch(pattern, name)
            if found is not None:
                return replacement(found)
        return None

    return rename


def _folded_biases(shapes: Shapes) -> dict[str, str]:
    """Biases of the residual sparse convolutions, by the running mean of the batch normalisation behind them."""
    found = (re.fullmatch(r"(backbone_3d\.conv\d\.\d\.)conv([12])\.bias", name) for name in shapes)
    return {f"{match[1]}bn{match[2]}.running_mean": match[0] for match in found if match is not None}


def _refuse_kernels_turned_wrongly(entries: list[Entry], to: Framework) -> None:
    """OpenPCDet turns a kernel (z, y, x, in, out) whose shape is not the model's (out, z, y, x, in); it first tries
    whether a swap of the last two axes gives that shape, which it does where out = z = y = x."""
    wrong = []
    for entry in entries:
        if entry.axes == KRSC_TO_DHWIO:
            z, y, x, channels, out = entry.their_shape
            if (z, y, x, out, channels) == entry.shape:
                wrong.append(entry.ours)
    if wrong:
        raise LayoutError(
            f"{to}: sparse kernels must have more output channels than their edge is long, or the framework turns them "
            f"the wrong way on loading, got {_list(wrong)}"
        )


def _options_of_file(
    state: Mapping[str, Tensor], shapes: Shapes, options: LayoutOptions, conv_here: bool
) -> LayoutOptions:
    prefix, dynamic, conv = options.prefix, options.dynamic_pillars, options.stride1_conv
    if prefix is None:
        prefix = "pts_" if any(re.match(r"(\w+\.)?pts_", name) for name in state) else ""
    dynamic = dynamic or any(re.search(r"voxel_encoder\.pfn_layers\.0\.0\.weight$", name) for name in state)
    if conv is None:
        said: set[bool] = set()
        deblocks = {name: shape for name, shape in shapes.items() if is_stride1_deblock(name, shape)}
        for name, shape in deblocks.items():
            theirs = state.get(prefix + "neck." + name.removeprefix("backbone_2d."))
            if theirs is not None and shape[0] != shape[1]:
                said.add((tuple(theirs.shape) != shape) != conv_here)
        if len(said) != 1 and deblocks:
            raise LayoutError(
                "mmdet3d: deblocks of stride 1 must show by their shapes whether they are Conv2d or ConvTranspose2d, "
                "got as many channels in as out; say it with --stride1-deblock"
            )
        conv = said.pop() if said else False
    return LayoutOptions(prefix=prefix, stride1_conv=conv, dynamic_pillars=dynamic)


def _require_usable(state: Mapping[str, Tensor]) -> None:
    for name, tensor in state.items():
        wanted = (
            (torch.int64,) if name.endswith("num_batches_tracked") else (torch.float32, torch.float16, torch.bfloat16)
        )
        if tensor.dtype not in wanted:
            raise LayoutError(f"{name}: must be {_dtype(wanted[0])}, got {_dtype(tensor.dtype)}")
        if not bool(torch.isfinite(tensor).all()):
            bad = int((~torch.isfinite(tensor)).sum())
            raise LayoutError(f"{name}: weights must be finite, got {bad} of {tensor.numel()} that are NaN or infinite")


def _inverse(axes: tuple[int, ...]) -> list[int]:
    return [axes.index(axis) for axis in range(len(axes))]


def _dtype(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _text(shape: Shape) -> str:
    return f"({', '.join(map(str, shape))})"


def _list(names: Collection[str]) -> str:
    names = list(names)
    rest = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + rest
