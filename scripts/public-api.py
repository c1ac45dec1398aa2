#!/usr/bin/env python3
"""Lists the public API of the library, one item per line.

    scripts/public-api.py            compares it with docs/public-api.txt, and counts the items
    scripts/public-api.py --write    rewrites that file
    scripts/public-api.py --embedded checks and counts the part that a host without files sees

Reads rustdoc's JSON of the crate and of those that it exports names of. Fields, variants and trait implementations
belong to their type and do not count as items.
"""

import difflib
import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SNAPSHOT = ROOT / "docs/public-api.txt"
# The version of rustdoc's JSON that this script reads.
FORMAT = 57


# The package, and the crates that it exports names of.
PACKAGES = ["nightsplat", "nightsplat-core", "nightsplat-models", "nightsplat-photographs", "nightsplat-synth"]


def documented(package: str, features: str) -> dict:
    """Rustdoc's JSON of a library."""
    command = ["cargo", "rustdoc", "--quiet", "--package", package, "--lib", "--no-default-features"]
    command += ["--features", features]
    # The modules that names are exported of are hidden.
    options = ["-Z", "unstable-options", "--output-format", "json", "--document-hidden-items", "--cap-lints", "allow"]
    metadata = subprocess.run(
        ["cargo", "metadata", "--no-deps", "--format-version", "1"], cwd=ROOT, check=True, capture_output=True
    )
    target = Path(json.loads(metadata.stdout)["target_directory"])
    # The JSON is unstable; this lets the project's own rustdoc write it. Set for cargo, the variable would compile many
    # dependencies again.
    rustdoc = target / "rustdoc-of-json"
    target.mkdir(parents=True, exist_ok=True)
    rustdoc.write_text('#!/bin/sh\nRUSTC_BOOTSTRAP=1 exec rustdoc "$@"\n')
    rustdoc.chmod(0o755)
    environment = os.environ | {"RUSTDOC": str(rustdoc)}
    subprocess.run([*command, "--", *options], cwd=ROOT, env=environment, check=True)
    crate = json.loads((target / f"doc/{package.replace('-', '_')}.json").read_text())
    if crate["format_version"] != FORMAT:
        sys.exit(f"rustdoc writes JSON of version {crate['format_version']}; {__file__} reads {FORMAT}: adapt it")
    return crate


# ---------------------------------------------------------------------------
# Types, as Rust writes them


def arguments(args: dict | None) -> str:
    if not args:
        return ""
    if "parenthesized" in args:
        inner = args["parenthesized"]
        output = f" -> {typed(inner['output'])}" if inner["output"] else ""
        return f"({', '.join(map(typed, inner['inputs']))}){output}"
    inner = args["angle_bracketed"]
    given = [next(iter(arg.values())) if "lifetime" in arg else value(arg) for arg in inner["args"]]
    constraints = [one for one in inner["constraints"] if "equality" in one["binding"]]
    bound = [f"{one['name']} = {value(one['binding']['equality'])}" for one in constraints]
    return f"<{', '.join(given + bound)}>" if given or bound else ""


def value(term: dict) -> str:
    if "type" in term:
        return typed(term["type"])
    return term["constant"]["expr"] if "constant" in term else next(iter(term))


def bounds(all_bounds: list) -> str:
    return " + ".join(map(bound, all_bounds))


def bound(one: dict) -> str:
    if "outlives" in one:
        return one["outlives"]
    if "use" in one:
        return "use<..>"
    inner = one["trait_bound"]
    maybe = "?" if inner["modifier"] == "maybe" else ""
    return maybe + named(inner["trait"])


# The ids of the types that a signature names, in the crate that is being read.
NAMED: set[int] = set()


def named(path: dict) -> str:
    """The last segment of a path, as in code that imports it."""
    NAMED.add(path["id"])
    return path["path"].split("::")[-1] + arguments(path["args"])


def typed(kind: dict | None) -> str:
    if kind is None:
        return "()"
    (name, inner), = kind.items()
    match name:
        case "primitive" | "generic":
            return inner
        case "resolved_path":
            return named(inner)
        case "borrowed_ref":
            lifetime = f"{inner['lifetime']} " if inner["lifetime"] else ""
            return f"&{lifetime}{'mut ' if inner['is_mutable'] else ''}{typed(inner['type'])}"
        case "raw_pointer":
            return f"*{'mut' if inner['is_mutable'] else 'const'} {typed(inner['type'])}"
        case "slice":
            return f"[{typed(inner)}]"
        case "array":
            return f"[{typed(inner['type'])}; {inner['len']}]"
        case "tuple":
            return f"({', '.join(map(typed, inner))})"
        case "impl_trait":
            return f"impl {bounds(inner)}"
        case "dyn_trait":
            return f"dyn {' + '.join(named(one['trait']) for one in inner['traits'])}"
        case "qualified_path":
            return f"{typed(inner['self_type'])}::{inner['name']}"
        case "function_pointer":
            return f"fn{signature(inner['sig'])}"
    return name


def generics(declared: dict) -> str:
    shown = []
    for one in declared["params"]:
        (kind, inner), = one["kind"].items()
        if kind == "type" and not inner["is_synthetic"]:
            shown.append(one["name"] + (f": {bounds(inner['bounds'])}" if inner["bounds"] else ""))
        elif kind == "lifetime":
            shown.append(one["name"])
        elif kind == "const":
            shown.append(f"const {one['name']}: {typed(inner['type'])}")
    return f"<{', '.join(shown)}>" if shown else ""


def signature(sig: dict) -> str:
    def parameter(name: str, kind: dict) -> str:
        if name != "self":
            return f"{name}: {typed(kind)}"
        return typed(kind).replace("Self", "self")

    output = f" -> {typed(sig['output'])}" if sig["output"] else ""
    return f"({', '.join(parameter(*one) for one in sig['inputs'])}){output}"


# ---------------------------------------------------------------------------
# Items


def is_hidden(item: dict) -> bool:
    """Whether an item is no API: `#[doc(hidden)]`."""
    return any("hidden" in str(attribute) for attribute in item["attrs"])


class Api:
    """The lines of the API, and its numbers of items and parts."""

    def __init__(self, crates: dict[str, dict]):
        self.crates = crates
        self.lines: list[str] = []
        self.items = 0
        self.parts = 0
        self.seen: set[tuple] = set()
        self.traits: list[tuple] = []
        named: set[tuple] = set()
        self.named = named
        self.enter("nightsplat", lambda: self.module(self.index[str(self.crate["root"])], "nightsplat"))
        self.hidden = sorted(path[-1] for path in named - self.seen if path[0] in crates)
        self.add_traits()
        self.lines.sort(key=lambda line: line.split(" ", 1)[1])

    def enter(self, name: str, read) -> None:
        """Reads items of a crate, whose ids are its own."""
        before, self.crate = getattr(self, "crate", None), self.crates[name]
        self.index = self.crate["index"]
        outer = NAMED.copy()
        NAMED.clear()
        read()
        self.named |= {self.path(number) for number in NAMED} - {None}
        NAMED.clear()
        NAMED.update(outer)
        if before:
            self.crate, self.index = before, before["index"]

    def path(self, number: int) -> tuple | None:
        """Where an item is defined."""
        summary = self.crate["paths"].get(str(number))
        return tuple(summary["path"]) if summary else None

    def defined(self, path: tuple | None) -> tuple[str, dict] | None:
        """The crate and the item of a path."""
        crate = self.crates.get(path[0]) if path else None
        for number, summary in crate["paths"].items() if crate else ():
            if summary["crate_id"] == 0 and tuple(summary["path"]) == path and number in crate["index"]:
                return path[0], crate["index"][number]
        return None

    def add(self, kind: str, path: str, rest: str = "") -> None:
        self.items += kind not in ("field", "variant", "impl")
        self.parts += kind in ("field", "variant")
        self.lines.append(f"{kind} {path}{rest}")

    def module(self, module: dict, path: str) -> None:
        for number in module["inner"]["module"]["items"]:
            item = self.index[str(number)]
            if is_hidden(item):
                continue
            (kind, inner), = item["inner"].items()
            if kind != "use":
                self.item(item, f"{path}::{item['name']}")
            elif str(inner["id"]) in self.index:
                target = self.index[str(inner["id"])]
                if inner["is_glob"]:
                    self.module(target, path)
                else:
                    self.item(target, f"{path}::{inner['name']}")
            elif found := self.defined(self.path(inner["id"])):
                name = f"{path}::{inner['name']}"
                self.enter(found[0], lambda item=found[1], name=name: self.item(item, name))
            else:
                self.add("use", f"{path}::{inner['name']}", f" = {inner['source']}")

    def item(self, item: dict, path: str) -> None:
        (kind, inner), = item["inner"].items()
        defined = self.path(item["id"]) or (path,)
        if defined in self.seen:
            return self.add("use", path)
        self.seen.add(defined)
        match kind:
            case "module":
                self.add("mod", path)
                self.module(item, path)
            case "struct" | "enum" | "union":
                self.add(kind, path, generics(inner["generics"]))
                self.members(inner, path)
                self.implementations(inner["impls"], path)
            case "trait":
                supers = f": {bounds(inner['bounds'])}" if inner["bounds"] else ""
                self.add("trait", path, generics(inner["generics"]) + supers)
                for number in inner["items"]:
                    self.associated(self.index[str(number)], path)
            case "function":
                self.add("fn", path, generics(inner["generics"]) + signature(inner["sig"]))
            case "constant" | "static":
                self.add("const", path, f": {typed(inner['type'])}")
            case "type_alias":
                self.add("type", path, f" = {typed(inner['type'])}")
            case _:
                self.add(kind, path)

    def members(self, inner: dict, path: str) -> None:
        """The fields of a struct, the variants of an enum."""
        for number in inner.get("variants", []):
            variant = self.index[str(number)]
            kind = variant["inner"]["variant"]["kind"]
            self.add("variant", f"{path}::{variant['name']}", self.held(kind))
        kind = inner.get("kind", "unit")
        if kind != "unit":
            fields = kind["plain"]["fields"] if "plain" in kind else kind["tuple"]
            for number in fields:
                if number is not None and str(number) in self.index:
                    field = self.index[str(number)]
                    if is_hidden(field):
                        continue
                    self.add("field", f"{path}::{field['name']}", f": {typed(field['inner']['struct_field'])}")

    def held(self, kind: dict | str) -> str:
        """The fields of a variant."""
        def field(number: int) -> str:
            return typed(self.index[str(number)]["inner"]["struct_field"])

        if kind == "plain":
            return ""
        if "tuple" in kind:
            return f"({', '.join(field(number) for number in kind['tuple'] if number is not None)})"
        named_fields = kind["struct"]["fields"]
        return f" {{ {', '.join(self.index[str(number)]['name'] + ': ' + field(number) for number in named_fields)} }}"

    def implementations(self, numbers: list[int], path: str) -> None:
        traits = []
        outer = NAMED.copy()
        for number in numbers:
            block = self.index[str(number)]["inner"]["impl"]
            if is_hidden(self.index[str(number)]):
                continue
            if block["trait"] is None:
                for one in block["items"]:
                    self.associated(self.index[str(one)], path)
            elif not block["is_synthetic"] and block["blanket_impl"] is None and not block["is_negative"]:
                NAMED.clear()
                text = named(block["trait"])
                traits.append((text, {self.path(number) for number in NAMED} - {None}))
        NAMED.clear()
        NAMED.update(outer)
        self.traits.append((path, traits))

    def add_traits(self) -> None:
        """The traits of each type, but for those of the compiler and those that name what is no API."""
        for path, traits in self.traits:
            shown = {
                text
                for text, types in traits
                if text not in ("StructuralPartialEq", "TrivialClone")
                and all(one in self.seen for one in types if one[0] in self.crates)
            }
            if shown:
                self.add("impl", path, f": {', '.join(sorted(shown))}")

    def associated(self, item: dict, path: str) -> None:
        if is_hidden(item):
            return
        (kind, inner), = item["inner"].items()
        path = f"{path}::{item['name']}"
        match kind:
            case "function":
                self.add("fn", path, generics(inner["generics"]) + signature(inner["sig"]))
            case "assoc_const":
                self.add("const", path, f": {typed(inner['type'])}")
            case "assoc_type":
                self.add("type", path)


def main() -> None:
    is_embedded = sys.argv[1:] == ["--embedded"]
    features = {"nightsplat": "glslang"}
    if not is_embedded:
        features = {"nightsplat": "glslang,train", "nightsplat-models": "train"}
    packages = PACKAGES[:3] if is_embedded else PACKAGES
    crates = {package: documented(package, features.get(package, "")) for package in packages}
    api = Api({package.replace("-", "_"): crate for package, crate in crates.items()})
    print(f"{api.items} public items, {api.parts} fields and variants")
    if api.hidden:
        sys.exit(f"the API uses types that are not part of it: {', '.join(api.hidden)}")
    text = "\n".join(api.lines) + "\n"
    if is_embedded:
        return
    if sys.argv[1:] == ["--write"]:
        SNAPSHOT.write_text(text)
    elif text != (before := SNAPSHOT.read_text()):
        sys.stdout.writelines(
            difflib.unified_diff(before.splitlines(True), text.splitlines(True), "docs/public-api.txt", "now", n=0)
        )
        remedy = "if that is meant: scripts/public-api.py --write, and a line in CHANGELOG.md"
        sys.exit(f"the public API has changed; {remedy}")


if __name__ == "__main__":
    main()
