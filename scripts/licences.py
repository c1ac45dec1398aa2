#!/usr/bin/env python3
"""Prints the licence texts of every crate in a program: scripts/licences.py [CARGO METADATA OPTIONS]

In: Cargo.lock and the sources of crates that cargo has fetched. Out: a text for an archive, crates of one licence text
together. Fails if a crate states no licence at all.
"""
import json
import pathlib
import subprocess
import sys

NAMES = ("license", "licence", "copying", "notice", "unlicense", "copyright")


def metadata(options):
    command = ["cargo", "metadata", "--format-version=1", "--locked", "--offline", *options]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def linked(graph):
    """The ids of the packages that are linked into the root package: no build scripts, no tests."""
    nodes = {node["id"]: node for node in graph["resolve"]["nodes"]}
    seen, ahead = set(), [graph["resolve"]["root"]]
    while ahead:
        package = ahead.pop()
        if package not in seen:
            seen.add(package)
            normal = lambda dep: any(kind["kind"] is None for kind in dep["dep_kinds"])
            ahead += [dep["pkg"] for dep in nodes[package]["deps"] if normal(dep)]
    return seen


def texts(package):
    """The licence files of a package."""
    folder = pathlib.Path(package["manifest_path"]).parent
    found = [path for path in sorted(folder.iterdir()) if path.is_file() and path.name.lower().startswith(NAMES)]
    if package["license_file"]:
        found.append(folder / package["license_file"])
    return {path.read_text(errors="replace").strip() for path in found}


def main():
    graph = metadata(sys.argv[1:])
    packages = {package["id"]: package for package in graph["packages"]}
    # Members of the workspace have the licences beside this text.
    of_others = [packages[id] for id in linked(graph) if packages[id]["source"]]
    by_text, without = {}, []
    for package in sorted(of_others, key=lambda package: package["name"]):
        name = f'{package["name"]} {package["version"]} ({package["license"]})'
        found = texts(package)
        for text in found:
            by_text.setdefault(text, []).append(name)
        if not found:
            without.append(name)
    print("nightsplat contains the crates below, under these licences.\n")
    if without:
        print("Without a licence file of their own, under the licences that are named:\n")
        print("\n".join(without) + "\n")
    for text, names in sorted(by_text.items(), key=lambda entry: entry[1]):
        print("=" * 80 + "\n" + "\n".join(names) + "\n" + "-" * 80 + "\n" + text + "\n")
    if any("(None)" in name for name in without):
        sys.exit("crates without a licence: " + ", ".join(without))


if __name__ == "__main__":
    main()
