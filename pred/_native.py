# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The compiled library: whether it is there, and if not, why.

``PRED_BACKEND`` is read at each eager call: ``auto`` (native where possible), ``native`` (an error where it
is not) or ``reference`` (plain PyTorch). A compiled graph keeps the value it was traced with.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

_FOLDER = Path(__file__).resolve().parent
_LIBRARY = _FOLDER / ("libpred_cpu.dylib" if sys.platform == "darwin" else "libpred_cpu.so")
_CUDA_LIBRARY = _FOLDER / "libpred_cuda.so"
_EMULATED = _FOLDER / "libpred_emulated.so"
"""CUDA kernels that run on CPU tensors, in place of the CPU's own (PRED_CUDA=emulate): for tests."""
_INSTALL_HINT = "install torch first, then run: pip install --no-build-isolation ."


def _build_record() -> dict[str, Any]:
    """What the build left behind: ``native``, ``reason``, ``torch``."""
    try:
        return dict(json.loads((_FOLDER / "build_info.json").read_text()))
    except FileNotFoundError:
        return {"native": False, "reason": "the package was never built"}
    except (OSError, ValueError) as error:
        return {"native": False, "reason": f"build_info.json is unreadable: {error}"}


def _load(library: Path) -> str | None:
    """Loads a library once; returns why it does not load, or None."""
    try:
        torch.ops.load_library(str(library))
    except (OSError, RuntimeError) as error:
        return f"{library.name} does not load: {error.__cause__ or error}"  # the cause is the linker's own text
    return None


def _load_cpu() -> str | None:
    if not _LIBRARY.exists():
        return str(_build_record().get("reason") or f"{_LIBRARY.name} is not in {_FOLDER}")
    return _load(_LIBRARY) or (_load(_EMULATED) if _EMULATED.exists() else None)


def _load_cuda() -> str | None:
    if _MISSING is not None:
        return _MISSING
    if not _CUDA_LIBRARY.exists():
        return str(_build_record().get("no_cuda") or f"{_CUDA_LIBRARY.name} is not in {_FOLDER}")
    if torch.version.cuda is None:
        return "this torch is built without CUDA"
    return _load(_CUDA_LIBRARY)


_MISSING: str | None = _load_cpu()
_MISSING_CUDA: str | None = _load_cuda()
_warned_cuda: set[str] = set()

if _MISSING is not None and os.environ.get("PRED_BACKEND", "auto") == "auto":
    warnings.warn(
        f"pred: the compiled kernels are missing ({_MISSING}); slower PyTorch references are used. "
        f"To build them, {_INSTALL_HINT}",
        RuntimeWarning,
        stacklevel=2,
    )


def available() -> bool:
    """Whether the compiled CPU library is loaded."""
    return _MISSING is None


def native_status() -> dict[str, Any]:
    """Facts for ``pred doctor`` and benchmark records.

    Returns:
        ``available``, ``reason`` (why not, else None), ``path``, ``build`` (record of the build and, when loaded,
        compiler, build type, sanitizers and levels), ``cpu_capability`` (level in force, or None), ``cuda`` (whether
        there are CUDA kernels), ``cuda_reason`` (why not, else None), ``emulated`` (see :data:`_EMULATED`).
    """
    build = _build_record()
    level = None
    if available():
        lines = torch.ops.pred.build_info().splitlines()
        info = dict(line.split("=", 1) for line in lines)
        level = info.pop("level")
        build |= info
    return {
        "available": available(),
        "reason": _MISSING,
        "path": str(_LIBRARY),
        "build": build,
        "cpu_capability": level,
        "cuda": _MISSING_CUDA is None,
        "cuda_reason": _MISSING_CUDA,
        "emulated": _EMULATED.exists(),
    }


@torch.compiler.assume_constant_result
def _backend() -> str:
    backend = os.environ.get("PRED_BACKEND") or "auto"
    if backend not in ("auto", "native", "reference"):
        raise ValueError(f"PRED_BACKEND must be auto, native or reference, got {backend!r}")
    if backend == "native" and _MISSING is not None:
        raise RuntimeError(f"PRED_BACKEND=native, but the compiled kernels are missing ({_MISSING}); {_INSTALL_HINT}")
    return "reference" if _MISSING is not None else backend


@torch.compiler.assume_constant_result
def _has_kernel(op: str, device: str, required: bool) -> bool:
    key = {"cuda": "CUDA"}.get(device)
    if key is not None and torch._C._dispatch_has_kernel_for_dispatch_key(f"pred::{op}", key):
        return True
    why = f" ({_MISSING_CUDA})" if device == "cuda" and _MISSING_CUDA is not None else ""
    if required:
        raise RuntimeError(f"{op}: PRED_BACKEND=native, but there is no kernel for device {device!r}{why}")
    if op not in _warned_cuda:
        _warned_cuda.add(op)
        warnings.warn(f"{op}: no {device} kernel{why}; the PyTorch reference is used", RuntimeWarning, stacklevel=3)
    return False


def refuse_transforms(op: str) -> None:
    """First line of every public op.

    Raises:
        RuntimeError: the call is under ``torch.vmap``, another transform of ``torch.func``, or forward-mode
            differentiation, which would leave a derivative out without a word, or loop over a batch.
    """
    if torch.compiler.is_compiling():
        return
    interpreter = torch._C._functorch.peek_interpreter_stack()
    if interpreter is not None:
        if interpreter.key() == torch._C._functorch.TransformType.Vmap:
            raise RuntimeError(f"{op}: torch.vmap is not supported; call it once on the whole batch")
        raise RuntimeError(f"{op}: transforms of torch.func are not supported; use torch.autograd.grad")
    if torch.autograd.forward_ad._current_level >= 0:
        raise RuntimeError(f"{op}: forward-mode derivatives are not supported; use torch.autograd.grad")


def use_native(op: str, tensor: Tensor) -> bool:
    """Whether ``op`` runs compiled for tensors like this one.

    Raises:
        ValueError: ``PRED_BACKEND`` has an unknown value.
        RuntimeError: it is ``native`` and the library or a kernel for the tensor's device is missing.
    """
    backend = _backend()
    if backend == "reference":
        return False
    if tensor.device.type == "cpu":
        return True
    return _has_kernel(op, tensor.device.type, backend == "native")


def deterministic() -> bool:
    """Whether gradients of maps must have the same bits every time on CUDA too, where atomics are faster
    (``torch.use_deterministic_algorithms``)."""
    return torch.are_deterministic_algorithms_enabled()


@torch.compiler.assume_constant_result
def tf32() -> bool:
    """Whether products of float32 numbers may round them to TF32 on CUDA: torch's own setting for matrix products,
    ``torch.backends.cuda.matmul.fp32_precision`` or ``torch.set_float32_matmul_precision``."""
    return bool(torch.backends.cuda.matmul.fp32_precision == "tf32")


def checked(op: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a compiled op that checks values. Its ValueError and MemoryError pass through torch 2.13 unchanged, and
    arrive from torch 2.15 as a RuntimeError of the same text."""
    try:
        return op(*arguments)
    except RuntimeError as error:
        if "std::bad_alloc" in str(error):
            raise MemoryError(str(error)) from None
        if " must " in str(error).partition(": ")[2]:
            raise ValueError(str(error)) from None
        raise


def register(
    op: str,
    *,
    fake: Callable[..., Any],
    setup_context: Callable[..., None] | None = None,
    backward: Callable[..., Any] | None = None,
    differentiable: bool = True,
) -> None:
    """Registers what a compiled op needs beside its kernel: shapes, derivative and autocast rule.

    An op without ``backward`` raises by name when it is differentiated, since torch would otherwise leave the
    gradient out of a sum without a word. ``differentiable=False`` marks ops whose outputs are constants, which carry no
    gradient at all.
    Under ``torch.vmap`` every op raises by name, where torch would loop over the batch.
    """
    if not available():
        return
    name = f"pred::{op}"

    def checked_fake(*arguments: Any) -> Any:
        try:
            return fake(*arguments)
        except IndexError as error:
            raise ValueError(f"{op}: an argument has the wrong number of dimensions ({error})") from None
        except AttributeError as error:
            if "'NoneType' object" not in str(error):
                raise
            raise TypeError(f"{op}: an argument is None in place of a tensor ({error})") from None

    torch.library.register_fake(name, checked_fake)

    def refuse_vmap(*arguments: Any) -> None:
        raise RuntimeError(f"{op}: torch.vmap is not supported; call it once on the whole batch")

    torch.library.register_vmap(name, refuse_vmap)
    if not differentiable:
        setup_context, backward = _mark_constants, _no_gradients
    elif backward is None:

        def backward(ctx: Any, *grads: Tensor) -> None:
            raise RuntimeError(f"{op}: a further derivative is not supported")

        setup_context = _save_nothing
    torch.library.register_autograd(name, backward, setup_context=setup_context)
    for device in ("cpu", "cuda"):  # half-precision regions compute these ops in float32
        torch.library.register_autocast(name, device, torch.float32)


def _save_nothing(ctx: Any, inputs: Any, output: Any) -> None:
    pass


def _mark_constants(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.num_inputs = len(inputs)
    ctx.mark_non_differentiable(*(output if isinstance(output, tuple) else (output,)))


def _no_gradients(ctx: Any, *grads: Tensor) -> tuple[None, ...]:
    return (None,) * ctx.num_inputs
