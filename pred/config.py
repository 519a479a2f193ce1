# Copyright 2026 The PRED authors
# SPDX-License-Identifier: Apache-2.0
"""Reading and writing configurations: jsonargparse, plus bare names and a hint for unknown keys.

A configuration is a tree of dataclasses that live beside what they configure. Their defaults are the base; YAML files
and the command line hold differences only.
"""

from __future__ import annotations

import difflib
import re
from argparse import Namespace as ArgparseNamespace
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import yaml
from jsonargparse import ActionConfigFile, ArgumentParser, set_parsing_settings

CONFIG_FOLDER = Path(__file__).resolve().parent / "configs"

_UNKNOWN_KEY = re.compile(
    r"unrecognized arguments: (?P<option>--[\w.-]+)"
    r"|Group '(?P<group>[\w.]+)' does not accept option '(?P<member>[\w.]+)'"
    r"|Option '(?P<key>[\w.]+)' is not accepted"
)

set_parsing_settings(docstring_parse_attribute_docstrings=True)


class ConfigError(ValueError):
    """A configuration file or key cannot be used."""


class ConfigParser(ArgumentParser):
    """jsonargparse's parser with short errors that name the nearest known key."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        if not self.exit_on_error:  # an inner parser, of one dataclass: the outer one reports
            super().error(message, ex)
        self.exit(2, f"{self.prog}: error: {message}{self._hint(message)}\nrun '{self.prog} --help' for all options\n")

    def _hint(self, message: str) -> str:
        found = _UNKNOWN_KEY.search(message)
        if found is None:
            return ""
        if found["option"]:
            prefix, key = "--", found["option"].lstrip("-")
        else:
            prefix, key = "", found["key"] or f"{found['group']}.{found['member']}"
        known = [option.lstrip("-") for action in self._actions for option in action.option_strings]
        return did_you_mean(key, known, prefix)


class ConfigFile(ActionConfigFile):
    """``--config``: a YAML file, or the bare name of one in pred/configs."""

    def __call__(self, parser: Any, cfg: Any, values: Any, option_string: str | None = None) -> None:
        try:
            path = find_config(values)
        except ConfigError as error:
            parser.error(str(error))
        super().__call__(parser, cfg, path, option_string)


def did_you_mean(name: str, known: Iterable[str], prefix: str = "") -> str:
    """``"; did you mean …?"`` with the closest of the known names, or an empty text."""
    choices = list(known)
    nearest = difflib.get_close_matches(name, choices, n=1, cutoff=0.6)
    if not nearest:  # the right name in the wrong group, such as lr for train.lr
        last = name.rpartition(".")[2]
        nearest = [choice for choice in choices if choice.rpartition(".")[2] == last][:1]
    return f"; did you mean {prefix}{nearest[0]}?" if nearest else ""


def config_names() -> list[str]:
    """Names of the configurations that come with the package."""
    return sorted(path.stem for path in CONFIG_FOLDER.glob("*.yaml"))


def find_config(name: str) -> str:
    """The file a ``--config`` value means. Names without suffix or folder are looked up in pred/configs.

    Raises:
        ConfigError: neither such a file nor such a configuration exists.
    """
    if re.search(r"[\n:{]", name) and not Path(name).exists():  # inline YAML; jsonargparse reads it as it stands
        return name
    if Path(name).is_file():
        return name
    if re.fullmatch(r"\w+", name) and (CONFIG_FOLDER / f"{name}.yaml").is_file():
        return str(CONFIG_FOLDER / f"{name}.yaml")
    raise ConfigError(
        f"--config must name a YAML file or one of {', '.join(config_names())}; got {name!r}"
        f"{did_you_mean(name, config_names())}"
    )


def to_yaml(config: Any) -> str:
    """A dataclass tree as YAML, every value spelled out."""
    return str(yaml.safe_dump(plain(config), sort_keys=False))


def plain(config: Any) -> dict[str, Any]:
    """A dataclass tree as dictionaries, lists and plain values."""
    return dict(_without_tuples(asdict(config)))


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """``{"a": {"b": 1}}`` to ``{"a.b": 1}``."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _without_tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_tuples(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_tuples(item) for item in value]
    return value


def config_parser(prog: str, description: str, config_class: type, skip: set[str] | None = None) -> ConfigParser:
    """A parser whose options are ``--config``, ``--print_config`` and every field of a dataclass tree."""
    parser = ConfigParser(prog=prog, description=description)
    parser.add_argument(
        "--config",
        action=ConfigFile,
        help=f"YAML file or one of {', '.join(config_names())}; later options and files override earlier ones",
    )
    parser.add_class_arguments(config_class, skip=skip)
    return parser


def build(parser: ConfigParser, config_class: Any, arguments: ArgparseNamespace, skip: Iterable[str] = ()) -> Any:
    """The dataclass tree that parsed arguments describe.

    Raises:
        ConfigError: a value breaks a rule between fields.
    """
    try:
        tree = parser.instantiate(arguments)
        names = [name for name in config_class.__dataclass_fields__ if name not in skip]
        return config_class(**{name: tree[name] for name in names})
    except ValueError as error:
        raise ConfigError(str(error)) from error
