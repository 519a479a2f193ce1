# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""The documentation: its examples run, and it leaves out no op and no page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.ops.examples import PUBLIC

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
RUN = [*PAGES, ROOT / "README.md"]
PYTHON = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.fixture
def _default_dtype() -> Iterator[None]:
    """A page that changes it does not change it for the next test, even where it fails."""
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.usefixtures("_default_dtype")
@pytest.mark.parametrize("page", RUN, ids=lambda page: str(page.relative_to(ROOT)))
def test_python_blocks_run(page: Path) -> None:
    """From top to bottom in one namespace."""
    text = page.read_text()
    namespace: dict[str, Any] = {}
    torch.manual_seed(0)
    for match in PYTHON.finditer(text):
        line = text[: match.start(1)].count("\n")
        exec(compile("\n" * line + match.group(1), str(page), "exec"), namespace)


def test_every_op_is_listed() -> None:
    listed = re.findall(r"^\| `(\w+)` \|.*\]\((\w+\.md)\) \|$", (ROOT / "docs/ops/index.md").read_text(), re.MULTILINE)
    missing = set(PUBLIC) - {op for op, _ in listed}
    assert not missing
    for op, page in listed:
        if op in PUBLIC and (ROOT / "docs/ops" / page).exists():
            assert op in (ROOT / "docs/ops" / page).read_text(), f"{page} does not mention {op}"


def test_every_page_is_in_the_navigation() -> None:
    listed = re.findall(r"([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert {str(page.relative_to(ROOT / "docs")) for page in PAGES} <= set(listed)
