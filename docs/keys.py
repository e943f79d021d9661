"""Keys of the configuration as Markdown, from the classes of the settings and from config/."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

LIMITS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
HEAD = ("| key | type | allowed | default | meaning |", "|---|---|---|---|---|")
PRESETS = ("network_train", "preset")
"""Groups of options that set keys of several groups."""

Schema = Mapping[str, Any]


def reference() -> Iterator[str]:
    """Markdown of all groups: their keys and, below, their options."""
    from psfdae_paper.configuration.base import config_dir
    from psfdae_paper.configuration.compose import compose
    from psfdae_paper.configuration.schema import whole_config

    schema, tree = whole_config().model_json_schema(), compose()
    for group in (*schema["properties"], *PRESETS):
        yield f"\n### `{group}`\n"
        if group not in PRESETS:
            yield from (*HEAD, *_rows(group, schema["properties"][group], schema, tree.get(group)))
        yield ""
        for option in sorted((config_dir() / group).glob("[!_]*.yaml")):
            comment = re.match(r"(?:#.*\n)*", option.read_text(encoding="utf-8"))[0]
            lines = re.findall(r"^# ?(?! *@package)(.+)", comment, re.M)
            yield f"- `{group}={option.stem}`{': ' if lines else ''}{' '.join(lines)}"


def _rows(key: str, about: Schema, schema: Schema, value: Any) -> Iterator[str]:
    """Rows of a key, or of the keys of the groups that it may hold."""
    members = [about, *about.get("anyOf", []), *about.get("oneOf", [])]
    members += [*about.get("patternProperties", {}).values()]
    forms = [m["$ref"].rsplit("/", 1)[-1] for m in members if "$ref" in m]
    for form in forms:
        group = schema["$defs"][form]
        yield f"| **{key}** | {form} | | | {_sentence(group)} |"
        for name, inner in group["properties"].items():
            known = value.get(name) if isinstance(value, Mapping) else None
            yield from _rows(f"{key}.{name}", inner, schema, known)
    if not forms:
        kinds = dict.fromkeys(m["type"] for m in members if "type" in m)
        value = about.get("default") if value is None else value
        default = "" if value is None else f"`{json.dumps(value, ensure_ascii=False)}`"
        limits = ", ".join(limit for m in members for limit in _limits(m))
        meaning = _sentence(about).removesuffix(".")
        cells = (f"`{key}`", " or ".join(kinds), limits, default, meaning)
        yield f"| {' | '.join(cells)} |"


def _limits(about: Schema) -> list[str]:
    found = [f"{sign} {about[key]:g}" for key, sign in LIMITS.items() if key in about]
    found += [f"`{value}`" for value in about.get("enum", [about.get("const")]) if value]
    return found + (_limits(about["items"]) if "items" in about else [])


def _sentence(about: Schema) -> str:
    """The meaning; a key without one stops the build."""
    return " ".join(about["description"].split("\n\n")[0].split())
