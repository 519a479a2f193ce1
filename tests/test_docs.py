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
CODE = re.compile(r"^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#\s]*)#?([^)\s]*)\)")


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
    """In the order of ``pred.ops.__all__``, with a page that mentions it."""
    listed = re.findall(r"^\| `(\w+)` \|.*\]\((\w+\.md)\) \|$", (ROOT / "docs/ops/index.md").read_text(), re.MULTILINE)
    assert [op for op, _ in listed] == PUBLIC
    for op, page in listed:
        assert f"`{op}" in (ROOT / "docs/ops" / page).read_text(), f"{page} does not mention {op}"


def test_the_navigation_names_every_page_once() -> None:
    named = re.findall(r"([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(named) == sorted(str(page.relative_to(ROOT / "docs")) for page in PAGES)


def anchors(page: Path) -> set[str]:
    """Of the headings, as the site makes them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = (re.sub(r"[^\w\s-]", "", line) for line in re.findall(r"^#+ (.*)$", text, re.MULTILINE))
    return {re.sub(r"[-\s]+", "-", heading.strip().lower()) for heading in headings}


@pytest.mark.parametrize("page", [*RUN, ROOT / "CONTRIBUTING.md"], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    """Files, and headings in them. Pages of the site do not lead out of it."""
    for target, anchor in LINK.findall(CODE.sub("", page.read_text())):
        if "://" in target:
            continue
        file = (page.parent / target).resolve() if target else page
        assert file.exists(), f"{target} is not there"
        assert page not in PAGES or file in PAGES, f"{target} is no page of the site"
        assert not anchor or anchor in anchors(file), f"{target} has no heading {anchor}"
