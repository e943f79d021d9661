"""Reference of the configuration: every key with type, unit, range, default and meaning."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

UNITS = {
    "_m": "m",
    "_um2": "µm²",
    "_deg": "°",
    "_arcsec": "″",
    "_px": "px",
    "_waves": "waves",
    "_seconds": "s",
    "_s": "s",
    "_photons": "photons",
}
"""Unit by the end of a key."""

KIND_OF = {"integer": "integer", "number": "number", "string": "text", "boolean": "true or false"}
LIMITS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
MOST_LEAVES = 30
"""An option that sets more is not listed key by key."""

NAME_PATTERN = "^[A-Za-z0-9_]+$"

Schema = Mapping[str, Any]


@dataclass(frozen=True)
class Key:
    """One row of the reference; every field is Markdown."""

    name: str
    kind: str
    allowed: str
    default: str
    meaning: str


def key_reference(
    model: type[BaseModel],
    trees: Sequence[Mapping[str, Any]],
    folder: Path,
    listed: Collection[str] = (),
) -> str:
    """Sections of all groups of a root of the configuration, in Markdown.

    Parameters
    ----------
    model : pydantic model of the root
    trees : composed configurations; a key's default is its value in the first one
        that has the group in this form
    folder : folder with one sub-folder per group, one file per option
    listed : groups whose options are listed elsewhere
    """
    schema = model.model_json_schema()
    top = {k: v for k, v in schema["properties"].items() if not _forms(v, schema)}
    lines = ["### At the top", "", *_table(_rows({"properties": top}, schema, trees[0]))]
    for group, described in schema["properties"].items():
        if group in top:
            continue
        lines += [f"### `{group}`", ""]
        shown: dict[str, Any] = {}
        for form in _forms(described, schema):
            tree = next((t[group] for t in trees if _fits(form, t.get(group))), {})
            lines += [_sentence(form.get("description", "")), ""]
            new = {k: v for k, v in form["properties"].items() if shown.get(k) != v}
            lines += ["As above, and:", ""] if len(new) < len(form["properties"]) else []
            lines += _table(_rows({"properties": new}, schema, tree))
            shown |= form["properties"]
        lines += options(folder / group) if group not in listed else []
    return "\n".join(lines).strip()


def choices(folder: Path, groups: Sequence[str]) -> str:
    """Sections of groups whose options set keys of several groups."""
    lines: list[str] = []
    for group in groups:
        lines += [f"### `{group}`", "", *options(folder / group)]
    return "\n".join(lines).strip()


def undescribed(model: type[BaseModel]) -> list[str]:
    """Keys without a meaning, as class.key; the reference needs one for each."""
    schema = model.model_json_schema()
    forms = {model.__name__: schema, **schema["$defs"]}
    return sorted(
        f"{name}.{key}"
        for name, form in forms.items()
        for key, described in form["properties"].items()
        if not described.get("description") and not _forms(described, schema)
    )


def options(folder: Path) -> list[str]:
    """One list item per option of a group: its name, its comment and what it sets."""
    import yaml

    items = []
    paths = sorted(folder.glob("[!_]*.yaml"))
    for path in paths:
        text = path.read_text(encoding="utf-8")
        own = yaml.safe_load(text) or {}
        taken = [_taken(item, folder.name) for item in own.pop("defaults", [])]
        leaves = [f"`{key}: {_literal(value)}`" for key, value in _leaves(own)]
        parts = [f"`{path.stem}`:", _comment(text)]
        parts += [f"Takes {', '.join(filter(None, taken))}."] if any(taken) else []
        # The values of a group's only option are in the table.
        if len(paths) > 1 and 0 < len(leaves) <= MOST_LEAVES:
            parts.append(f"Sets {', '.join(leaves)}.")
        items.append("- " + " ".join(part for part in parts if part))
    if not items:
        return []
    return [f"Options, chosen by `{folder.name}=…`:", "", *items, ""]


def _taken(item: Any, group: str) -> str:
    """An entry of a defaults list; none for the file itself and for private files."""
    if isinstance(item, str):
        return "" if item.startswith("_") else f"`{group}={item}`"
    (group, option), *_ = item.items()
    return f"`{str(group).lstrip('/').removesuffix('@_here_')}={option}`"


def _comment(text: str) -> str:
    """The comment at the head of a file as a sentence."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            lines.append(line.removeprefix("#").strip())
    return _sentence(" ".join(lines))


def _sentence(text: str) -> str:
    text = " ".join(text.split("\n\n", maxsplit=1)[0].split())
    return text if not text or text.endswith((".", ":")) else text + "."


def _forms(described: Schema, schema: Schema) -> list[Schema]:
    """The classes that a key may hold; none if it holds a plain value."""
    if "$ref" in described:
        return [schema["$defs"][described["$ref"].rsplit("/", 1)[-1]]]
    members = described.get("oneOf", described.get("anyOf", []))
    return [form for member in members for form in _forms(member, schema)]


def _fits(form: Schema, tree: Any) -> bool:
    """Whether a part of a configuration has the keys and the kind of a form."""
    if not isinstance(tree, Mapping):
        return False
    kind = form["properties"].get("kind", {}).get("const")
    required = set(form.get("required", ()))
    return required <= set(tree) <= set(form["properties"]) and kind in (None, tree.get("kind"))


def _rows(form: Schema, schema: Schema, tree: Any, prefix: str = "") -> Iterator[Key]:
    tree = tree if isinstance(tree, Mapping) else {}
    for name, described in form["properties"].items():
        value, path = tree.get(name), prefix + name
        inner = _forms(described, schema)
        entry = next(iter(described.get("patternProperties", {}).values()), None)
        meaning = _sentence(described.get("description", ""))
        if entry is not None and _forms(entry, schema):
            inner, value = _forms(entry, schema), next(iter((value or {}).values()), None)
            path += ".NAME"
        if not inner:
            yield _key(path, described, value, name in tree)
            continue
        for part in inner:
            kind = part["properties"].get("kind", {}).get("const")
            about = " ".join(t for t in (meaning, _sentence(part.get("description", ""))) if t)
            title = f"**{path}**" + (f", kind {kind}" if len(inner) > 1 else "")
            yield Key(title, "", "", "", about)
            yield from _rows(part, schema, value if _fits(part, value) else {}, f"{path}.")


def _key(name: str, described: Schema, value: Any, known: bool) -> Key:
    unit = next((u for end, u in UNITS.items() if name.endswith(end)), "")
    if not known and "default" in described:
        value, known = described["default"], True
    return Key(
        f"`{name}`",
        _kind(described) + (f" ({unit})" if unit else ""),
        _allowed(described),
        f"`{_literal(value)}`" if known else "",
        _sentence(described.get("description", "")),
    )


def _kind(described: Schema) -> str:
    if "anyOf" in described:
        kinds = [_kind(member) for member in described["anyOf"] if member.get("type") != "null"]
        return ", ".join(dict.fromkeys(kinds)) + (
            " or null" if any(m.get("type") == "null" for m in described["anyOf"]) else ""
        )
    kind = described.get("type")
    if kind == "array":
        return f"list of {_kind(described.get('items', {}))}s".replace("texts", "names")
    if kind == "object":
        return "mapping"
    return KIND_OF.get(str(kind), "value")


def _allowed(described: Schema) -> str:
    if "anyOf" in described:
        parts = [_allowed(member) for member in described["anyOf"] if member.get("type") != "null"]
        return "; ".join(part for part in parts if part)
    if "const" in described:
        return f"`{described['const']}`"
    if "enum" in described:
        return ", ".join(f"`{value}`" for value in described["enum"])
    parts = [f"{sign} {_limit(described[key])}" for key, sign in LIMITS.items() if key in described]
    if "multipleOf" in described:
        parts.append(f"multiple of {described['multipleOf']}")
    if described.get("pattern") == NAME_PATTERN:
        parts.append("letters, digits, _")
    if "items" in described:
        parts.append(_allowed(described["items"]))
        least, most = described.get("minItems"), described.get("maxItems")
        if least == most and least is not None:
            parts.append(f"{least} of them")
        elif least is not None and least > 1:
            parts.append(f"at least {least} of them")
    return ", ".join(part for part in parts if part)


def _limit(value: float) -> str:
    return "2⁶³" if value == 2**63 else f"{value:g}"


def _literal(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, float):
        return f"{value:.12g}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_literal(item) for item in value) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k}: {_literal(v)}" for k, v in value.items()) + "}"
    return str(value)


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + str(key), value


def _table(rows: Iterator[Key]) -> list[str]:
    head = ["| key | type | allowed | default | meaning |", "|---|---|---|---|---|"]
    body = [
        "| " + " | ".join((r.name, r.kind, r.allowed, r.default, r.meaning)) + " |" for r in rows
    ]
    return [*head, *body, ""]
