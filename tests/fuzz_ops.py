# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Calls every op with random valid and invalid arguments and watches what comes of it.

    python -m tests.fuzz_ops --minutes 60 --seed 0    looks for findings
    python -m tests.fuzz_ops --only 123456            repeats one call

A call must give a result of the documented shape, or be refused; the compiled op and its reference must agree about
which. Refusals are

- ValueError or TypeError, of a public op in the form ``op: argument must <rule>, got <fact>``; a kernel that is called
  past it protects memory, and may use other words;
- RuntimeError of torch, for tensors that it does not compute with (of another layout, say), and of the dispatcher, for
  plain arguments whose types only it looks at;
- MemoryError, OverflowError or the text of std::length_error, where a size does not fit into memory or into int64.

All else is a finding: another exception or text, a shape that differs, a crash, a call that does not end. Calls run in
child processes, so that a crash is caught and named. ``make fuzz`` runs this on the sanitized library.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.symbolic_shapes import ShapeEnv

from pred import _native
from tests.ops.examples import EXAMPLES, LOW_PRECISION, Example, Source, outputs, recorded_calls

SEEDS_PER_RUN = 10**9
SECONDS_PER_CALL = 60
EXTRA_MEMORY = 6 << 30
ACCEPTED = (ValueError, TypeError, RuntimeError)
DTYPES = [
    torch.float32,
    torch.float64,
    torch.bfloat16,
    torch.float16,
    torch.int64,
    torch.int32,
    torch.uint8,
    torch.bool,
    torch.complex64,
]
SPECIAL = [float("nan"), float("inf"), -float("inf"), -0.0, 1e-45, -1e-45, 1e38, -1e38, 1e300, 2.0**31, 2.0**63, -1.0]
WHOLE = [0, 1, -1, 2, 3, 127, 2**31 - 1, 2**31, 2**53, 2**62, 2**63 - 1, -(2**63), 2**63, 2**64, -(2**31)]
WRONG: list[Any] = [None, "", "x", 3, -1, 2.5, True, [], [1.0], (), {}, object(), 1j, b"x", torch.float32, 10**400]


class RandomSource(Source):
    """Random sizes as well as random numbers."""

    def __init__(self, rng: random.Random) -> None:
        super().__init__(rng.randrange(2**31), rng.choice([0, 1, 2, 5, 33]))
        self._rng = rng

    def size(self, default: int, low: int, high: int) -> int:
        return self._rng.choice([default, low, self._rng.randint(low, min(high, low + 20))])


# --- mutations: each takes a value and gives a worse one ------------------------------------------


def _values(rng: random.Random, tensor: Tensor) -> Tensor:
    changed = tensor.detach().clone(memory_format=torch.contiguous_format)
    flat = changed.view(-1)
    for _ in range(rng.randint(1, 4) if flat.numel() else 0):
        at = rng.randrange(flat.numel())
        if tensor.is_floating_point():
            flat[at] = rng.choice(SPECIAL)
        elif tensor.dtype in (torch.int64, torch.int32):
            limit = torch.iinfo(tensor.dtype)
            flat[at] = max(limit.min, min(limit.max, rng.choice(WHOLE)))
    return changed


def _fill(rng: random.Random, tensor: Tensor) -> Tensor:
    if not tensor.is_floating_point():
        return torch.full_like(tensor, rng.choice([0, 1])) if tensor.dtype != torch.complex64 else tensor
    value = torch.tensor(rng.choice(SPECIAL), dtype=torch.float64).to(tensor.dtype)  # 1e300 becomes inf
    return value.expand(tensor.shape).contiguous()


def _shuffle(rng: random.Random, tensor: Tensor) -> Tensor:
    return tensor.flip(rng.randrange(tensor.dim())) if tensor.dim() else tensor.reshape(1)


def _rank(rng: random.Random, tensor: Tensor) -> Tensor:
    change: list[Callable[[], Tensor]] = [lambda: tensor[None], lambda: tensor[..., None], lambda: tensor.reshape(-1)]
    if tensor.dim() and tensor.shape[0]:
        change.append(lambda: tensor[0])
    change.append(lambda: tensor.new_zeros(()))
    change.append(lambda: tensor.new_zeros((1,) * rng.randint(2, 9)))
    return rng.choice(change)()


def _size(rng: random.Random, tensor: Tensor) -> Tensor:
    if not tensor.dim():
        return tensor.new_zeros(rng.choice([0, 1, 2]))
    dim = rng.randrange(tensor.dim())
    size = tensor.shape[dim]
    change = rng.choice(["shorter", "longer", "none", "one"])
    if change == "shorter":
        return tensor.narrow(dim, 0, max(size - 1, 0))
    if change == "longer":
        extra = [1 if at == dim else n for at, n in enumerate(tensor.shape)]
        return torch.cat([tensor, tensor.new_zeros(extra)], dim)
    return tensor.narrow(dim, 0, 0 if change == "none" else min(size, 1))


def _huge(rng: random.Random, tensor: Tensor) -> Tensor:
    """Shapes with more elements than memory holds, or with none in spite of huge sizes."""
    shape = list(tensor.shape) or [1]
    if rng.random() < 0.5:
        shape[rng.randrange(len(shape))] = 0
        shape = [n if n == 0 or rng.random() < 0.5 else rng.choice([2**31, 2**40, 2**62]) for n in shape]
        return tensor.new_empty(shape)
    shape = [max(n, 1) for n in shape]
    shape[rng.randrange(len(shape))] = rng.choice([2**34, 2**45, 2**60])
    return tensor.new_zeros([1] * len(shape)).expand(shape)


def _strides(rng: random.Random, tensor: Tensor) -> Tensor:
    if not tensor.dim():
        return tensor
    change = rng.choice(["permuted", "sliced", "expanded", "shifted", "overlapping"])
    dim = rng.randrange(tensor.dim())
    if change == "permuted":
        dims = rng.sample(range(tensor.dim()), tensor.dim())
        inverse = [dims.index(at) for at in range(tensor.dim())]
        return tensor.permute(dims).contiguous().permute(inverse)
    if change == "sliced":
        return tensor.repeat_interleave(2, dim)[(slice(None),) * dim + (slice(None, None, 2),)]
    if change == "expanded":
        return tensor.narrow(dim, 0, 1).expand_as(tensor) if tensor.shape[dim] else tensor
    memory = tensor.new_zeros(tensor.numel() + 1)
    memory[1:] = tensor.reshape(-1)
    if change == "shifted":
        return memory[1:].view(tensor.shape)
    return memory.as_strided(tensor.shape, [rng.choice([0, 1]) if n < 2 or tensor.numel() else 1 for n in tensor.shape])


def _dtype(rng: random.Random, tensor: Tensor) -> Tensor:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return tensor.to(rng.choice(DTYPES))


def _kind(rng: random.Random, tensor: Tensor) -> Any:
    if max(tensor.shape, default=0) > 1e6:  # to_sparse() of an empty tensor takes as long as its sizes are large
        return tensor
    change = rng.choice(["meta", "sparse", "numpy", "list", "parameter", "conjugate", "inference"])
    if change == "meta":
        return tensor.to("meta")
    if change == "sparse":
        return tensor.to_sparse()
    if change == "numpy":
        return tensor.float().numpy()
    if change == "list":
        return tensor.tolist() if tensor.numel() else []
    if change == "parameter" and tensor.is_floating_point():
        return torch.nn.Parameter(tensor)
    if change == "conjugate" and tensor.is_floating_point():
        return torch.complex(tensor.float(), tensor.float()).conj().imag  # carries a lazy negation
    with torch.inference_mode():
        return tensor.clone()


MUTATIONS = [_values, _values, _fill, _shuffle, _rank, _size, _size, _huge, _strides, _strides, _dtype, _kind]


def mutate(rng: random.Random, value: Any) -> Any:
    """A neighbour of ``value``, or something else altogether."""
    try:
        return _mutate(rng, value)
    except (RuntimeError, TypeError, ValueError, IndexError, OverflowError):
        return value  # of a sparse tensor, say, some neighbours do not exist


def _mutate(rng: random.Random, value: Any) -> Any:
    if rng.random() < 0.08:
        return rng.choice([*WRONG, torch.zeros(2, 3)])
    if isinstance(value, Tensor):
        return rng.choice(MUTATIONS)(rng, value)
    if isinstance(value, bool):
        return rng.choice([not value, None, 2, "yes"])
    if isinstance(value, int):
        return rng.choice([*WHOLE, value + 1, float(value), str(value), torch.tensor(value)])
    if isinstance(value, float):
        return rng.choice([*SPECIAL, 0, "x", torch.tensor(value)])
    if isinstance(value, str):
        longer = (value * 1000)[:10_000]
        return rng.choice(["", value.upper(), value + "\0", longer, "zeros", None, 0, b"zeros", [value]])
    if isinstance(value, (list, tuple)):
        items = list(value)
        if not items or rng.random() < 0.3:
            return rng.choice([items[1:], [*items, 1.0], items + items, [], str(items), torch.tensor(items)])
        items[rng.randrange(len(items))] = rng.choice([*SPECIAL, *WHOLE, None, "x", items])
        return items
    return rng.choice([*WRONG, torch.zeros(2, 3), torch.zeros(5)])


# --- one call --------------------------------------------------------------------------------------


class FindingError(Exception):
    """What a call must not do."""


def describe(value: Any) -> str:
    if isinstance(value, Tensor):
        shown = f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}"
        if value.layout != torch.strided or value.device.type != "cpu":
            return f"{shown} {value.layout} on {value.device}"
        if not value.is_contiguous():
            shown += f" strides {value.stride()}"
        return shown + (f" = {value.tolist()}" if 1 <= value.numel() <= 8 else "")
    text = repr(value)
    return text if len(text) <= 120 else text[:120] + "..."


@contextlib.contextmanager
def backend(name: str) -> Iterator[None]:
    before = os.environ.get("PRED_BACKEND")
    os.environ["PRED_BACKEND"] = name
    try:
        yield
    finally:
        os.environ.pop("PRED_BACKEND") if before is None else os.environ.update(PRED_BACKEND=before)


def attempt(function: Callable[[], Any]) -> tuple[Any, Exception | None]:
    """Result, or an exception of an accepted type."""
    try:
        return function(), None
    except (MemoryError, OverflowError) as error:
        return None, error
    except RecursionError as error:
        raise FindingError(f"endless recursion: {error}") from error
    except ACCEPTED as error:
        if "INTERNAL ASSERT" in str(error) or "report a bug" in str(error):
            raise FindingError(f"internal error: {error}") from error
        return None, error
    except Exception as error:
        raise FindingError(f"{type(error).__name__}: {error}\n{traceback.format_exc(limit=-4)}") from error


def is_too_large(error: Exception | None) -> bool:
    """std::bad_alloc, a whole number that int64 does not hold, or std::length_error, which arrives as a ValueError."""
    return isinstance(error, (MemoryError, OverflowError)) or str(error).startswith("vector::")


def is_ours(error: Exception) -> bool:
    """A ValueError or TypeError; torch's own are RuntimeErrors, or else a check of ours is missing."""
    return isinstance(error, (ValueError, TypeError)) and not is_too_large(error)


def require_form(op: str, who: str, error: Exception | None) -> None:
    if (
        error is not None
        and is_ours(error)
        and not re.match(rf"{op}: \w+(\[\d+\])? must .*, got ", str(error), re.DOTALL)
    ):
        raise FindingError(f"{who} does not say '{op}: argument must <rule>, got <fact>': {error!r}")


def rule(error: Exception) -> str:
    """The op and the argument that is blamed; C++ prints fewer digits of the numbers that follow."""
    return str(error).partition(" must ")[0]


def is_large(values: Iterable[Any]) -> bool:
    """Whether a size among the arguments is too large for the reference, which holds more than its result."""
    sizes = [
        max((value.numel(), *value.shape)) if isinstance(value, Tensor) else abs(value)
        for value in values
        if isinstance(value, (Tensor, int))
    ]
    return max(sizes, default=0) > 1e6


def shapes(result: dict[str, Tensor]) -> dict[str, Any]:
    return {name: (tuple(value.shape), value.dtype) for name, value in result.items()}


class Fuzzer:
    """Makes call number ``seed`` and judges it."""

    def __init__(self, announce: Callable[[str], None]) -> None:
        """``announce`` gets the text of each call before it is made."""
        self.announce = announce
        with backend("native"):
            self.direct = recorded_calls()
        self.direct["parallel_probe"] = [(torch.zeros(8, dtype=torch.int64), 1, -1)]
        self.targets: list[Example | str] = [*EXAMPLES, *LOW_PRECISION, *sorted(self.direct)]

    def run(self, seed: int) -> str:
        """What came of it: ``result``, or the name of the exception."""
        rng = random.Random(seed)
        target = rng.choice(self.targets)
        torch.manual_seed(0)
        return self.call_public(rng, target) if isinstance(target, Example) else self.call_direct(rng, target)

    def call_public(self, rng: random.Random, example: Example) -> str:
        arguments = example.arguments(RandomSource(rng), rng.choice([torch.float32, torch.float32, torch.float64]))
        for _ in range(rng.choice([0, 1, 1, 1, 2, 3])):
            name = rng.choice(list(arguments))
            arguments[name] = mutate(rng, arguments[name])
        shown = ", ".join(f"{name}={describe(value)}" for name, value in arguments.items())
        self.announce(f"pred.ops.{example.op}({shown})")
        tensors = [value for value in arguments.values() if isinstance(value, Tensor)]
        leaves = [
            x for x in tensors if x.is_floating_point() and x.numel() < 1e6 and x.is_leaf and not x.is_inference()
        ]
        differentiate = rng.random() < 0.6
        for leaf in leaves if differentiate else []:
            leaf.requires_grad_()

        def call() -> dict[str, Tensor]:
            return outputs(example.native(**arguments))

        with backend("native"):
            native, error = attempt(call)
        if any(x.is_inference() for x in tensors):
            return "result" if error is None else type(error).__name__  # autograd refuses some of them
        require_form(example.op, "the compiled op", error)
        large = is_large(arguments.values())
        if is_too_large(error) and not large:
            raise FindingError(f"nothing is large, and yet: {error!r}")
        if large:
            return "too large" if error is None else type(error).__name__
        with backend("reference"):
            expected, expected_error = attempt(call)
        require_form(example.op, "the reference", expected_error)
        if error is not None:
            if is_ours(error):
                if type(expected_error) is not type(error) or rule(expected_error) != rule(error):
                    raise FindingError(f"the compiled op says: {error!r}\nthe reference says: {expected_error!r}")
            elif expected_error is None and all(x.device.type == "cpu" for x in tensors) and "pred::" not in str(error):
                # The dispatcher (pred::) is stricter with the types of plain arguments than Python.
                raise FindingError(f"the reference accepts what the compiled op refuses: {error!r}")
            return type(error).__name__
        if expected_error is not None:
            if not is_ours(expected_error):
                return "result"  # some op of torch, on a tensor that carries a lazy negation, say
            raise FindingError(f"the compiled op accepts what the reference refuses: {expected_error!r}")
        if shapes(native) != shapes(expected):
            raise FindingError(f"results {shapes(native)}\nthe reference has {shapes(expected)}")
        targets = [value for value in native.values() if value.requires_grad]
        leaves = [leaf for leaf in leaves if leaf.requires_grad]
        if targets and leaves:
            cotangents = [torch.randn_like(value) for value in targets]
            if rng.random() < 0.3:
                cotangents = [_fill(rng, value) for value in cotangents]
            found, error = attempt(lambda: torch.autograd.grad(targets, leaves, cotangents, allow_unused=True))
            if error is not None:
                if max(size for leaf in leaves for size in (*leaf.shape, 0)) > 1e6:
                    return type(error).__name__  # no element, but sizes whose products overflow
                raise FindingError(f"the derivative fails: {error!r}")
            for leaf, grad in zip(leaves, found, strict=True):
                if grad is not None and (grad.shape != leaf.shape or grad.dtype != leaf.dtype):
                    raise FindingError(f"the gradient of {describe(leaf)} is {describe(grad)}")
        return "result"

    def call_direct(self, rng: random.Random, name: str) -> str:
        values = list(rng.choice(self.direct[name]))
        for _ in range(rng.choice([0, 1, 1, 1, 2, 3])):
            at = rng.randrange(len(values))
            values[at] = mutate(rng, values[at])
        self.announce(f"torch.ops.pred.{name}(" + ", ".join(describe(value) for value in values) + ")")
        op = getattr(torch.ops.pred, name)
        result, error = attempt(lambda: op(*values))
        if error is not None:
            large = is_large(item for value in values for item in (value if isinstance(value, list) else [value]))
            if is_too_large(error) and not large:
                raise FindingError(f"nothing is large, and yet: {error!r}")
            return type(error).__name__
        if name == "parallel_probe":
            return "result"
        found = {} if result is None else outputs(result)
        plain = [
            _as_number(value, argument) for value, argument in zip(values, op.default._schema.arguments, strict=False)
        ]
        with FakeTensorMode(shape_env=ShapeEnv(), allow_non_fake_inputs=True) as mode:
            fake = [mode.from_tensor(value, static_shapes=True) if type(value) is Tensor else value for value in plain]
            expected, fake_error = attempt(lambda: outputs(op(*fake)))
        if fake_error is not None and "pred::" not in str(fake_error):  # a tensor that stands for a number
            raise FindingError(f"the kernel accepts what its fake refuses: {fake_error!r}")
        for key, value in found.items() if fake_error is None else ():
            wanted = expected[key]
            fits = value.dim() == wanted.dim() and value.dtype == wanted.dtype
            sizes = zip(value.shape, wanted.shape, strict=False)
            if not fits or any(isinstance(want, int) and have != want for have, want in sizes):
                raise FindingError(f"{key} is {describe(value)}, its fake says {wanted.dtype}{list(wanted.shape)}")
        return "result"


def _as_number(value: Any, argument: torch.Argument) -> Any:
    """The number, or list, that torch reads from a tensor in its place; a fake tensor has none."""
    return value.tolist() if isinstance(value, Tensor) and "Tensor" not in str(argument.type) else value


# --- child and parent ------------------------------------------------------------------------------


def limit_memory() -> None:
    """Sizes that do not fit are refused at once. The sanitizers have limits of their own."""
    if _native.native_status()["build"].get("sanitizers"):
        return
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + EXTRA_MEMORY, resource.RLIM_INFINITY))


def child(first: int, last: int) -> None:
    """Makes the calls; a line on stdout before each (``call``), and what came of it."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(2)
    fuzzer = Fuzzer(lambda text: print("call", json.dumps(text), flush=True))
    limit_memory()
    faulthandler.enable()
    for seed in range(first, last):
        faulthandler.dump_traceback_later(SECONDS_PER_CALL, exit=True)  # wherever it is
        try:
            print("done", fuzzer.run(seed), flush=True)
        except FindingError as finding:
            print("finding", json.dumps(str(finding)), flush=True)


class Run:
    """The parent: starts a child, and another one where that ends."""

    def __init__(self, seed: int, findings_path: str | None) -> None:
        self.first = self.next = seed * SEEDS_PER_RUN
        self.counts: Counter[str] = Counter()
        self.findings: dict[int, str] = {}
        self.path = findings_path
        self.started = self.shown = time.monotonic()

    def until(self, end: float, calls: int | None) -> None:
        last = self.first + (SEEDS_PER_RUN if calls is None else calls)
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
        while self.next < last and time.monotonic() < end:
            with tempfile.TemporaryFile("w+") as stderr:
                process = subprocess.Popen(
                    [sys.executable, "-m", "tests.fuzz_ops", "--child", str(self.next), str(last)],
                    stdout=subprocess.PIPE,
                    stderr=stderr,
                    env=environment,
                    cwd=os.sep,  # `-m` puts the working folder first on the path
                    text=True,
                )
                assert process.stdout is not None
                text = ""
                for line in process.stdout:
                    word, _, rest = line.rstrip("\n").partition(" ")
                    if word == "done":
                        self.counts[rest] += 1
                    elif word == "finding":
                        self.add(f"{text}\n{json.loads(rest)}")
                    if word == "call":
                        text = json.loads(rest)
                    else:
                        self.next += 1
                    self.show(end, calls)
                    if time.monotonic() >= end:
                        process.kill()
                code = process.wait()
                if code != 0 and time.monotonic() < end:
                    stderr.seek(0)
                    tail = stderr.read()[-6000:]
                    if not text:
                        raise SystemExit(f"the child did not start (exit status {code}):\n{tail}")
                    name = signal.Signals(-code).name if code < 0 else f"exit status {code}"
                    self.add(f"{text}\nthe process died ({name}; a call may take {SECONDS_PER_CALL} s)\n{tail}")
                    self.next += 1

    def add(self, text: str) -> None:
        """A finding of the present call."""
        self.findings[self.next] = text
        shown = f"FINDING {self.next}: {text}\n  again: python -m tests.fuzz_ops --only {self.next}\n"
        print(shown, flush=True)
        if self.path:
            with open(self.path, "a") as file:
                file.write(shown + "\n")

    def show(self, end: float, calls: int | None) -> None:
        """Progress, every ten seconds."""
        now = time.monotonic()
        if now - self.shown < 10:
            return
        self.shown = now
        made = self.next - self.first
        left = end - now
        if calls is not None:
            left = min(left, (now - self.started) / max(made, 1) * (calls - made))
        print(
            f"{made} calls, {made / (now - self.started):.0f} a second, {len(self.findings)} findings, "
            f"{left / 60:.1f} min left",
            flush=True,
        )

    def summary(self) -> str:
        outcome = ", ".join(f"{count} {name}" for name, count in self.counts.most_common())
        return f"{sum(self.counts.values()) + len(self.findings)} calls: {outcome}; {len(self.findings)} findings"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz_ops", description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--calls", type=int, help="stop after so many calls (within the minutes)")
    parser.add_argument("--seed", type=int, default=0, help="other calls")
    parser.add_argument("--only", type=int, help="make this call alone, in this process")
    parser.add_argument("--findings", help="file to which findings are appended")
    parser.add_argument("--child", type=int, nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        child(*options.child)
        return 0
    status = _native.native_status()
    if not status["available"]:
        print(f"nothing to fuzz: {status['reason']}", file=sys.stderr)
        return 2
    if options.only is not None:
        warnings.simplefilter("ignore")
        fuzzer = Fuzzer(lambda text: print(text, flush=True))
        limit_memory()
        try:
            print(fuzzer.run(options.only))
        except FindingError as finding:
            print(finding)
            return 1
        return 0
    print(f"library: {status['path']} (sanitizers: {status['build'].get('sanitizers') or 'none'})", flush=True)
    run = Run(options.seed, options.findings)
    run.until(time.monotonic() + 60 * options.minutes, options.calls)
    print(run.summary())
    return 1 if run.findings else 0


if __name__ == "__main__":
    sys.exit(main())
