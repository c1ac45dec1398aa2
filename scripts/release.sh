#!/usr/bin/env bash
# Makes what a release consists of, installs each part into an empty Debian, and trains there: scripts/release.sh DIR
#
#   DIR/nightsplat-VERSION-TARGET.tar.gz     the program, man pages, completions, licences of all crates
#   DIR/nightsplat-capi-VERSION-TARGET.tar.gz  the C library with header, pkg-config and CMake files
#   DIR/*.crate                              the crates, as `cargo publish --workspace --dry-run` accepts them
#   DIR/*.whl                                the Python package
#   DIR/NOTES.md, DIR/SHA256SUMS             the changes of this version, the checksums
#
# Nothing is published: that is what .github/workflows/release.yml does, when a tag is pushed. The tree has to be clean,
# and its commit to have the tag vVERSION; `--untagged` is for a rehearsal. NIGHTSPLAT_PROFILE=dev rehearses with what is
# built already. The empty system comes from the first mirror of /etc/apt, or NIGHTSPLAT_MIRROR.
set -euo pipefail
cd "$(dirname "$0")/.."

untagged=
[ "${1:-}" != --untagged ] || { untagged=yes && shift; }
[ $# -eq 1 ] || { echo "usage: scripts/release.sh [--untagged] DIR" >&2; exit 2; }
mkdir -p "$1"
out=$(realpath "$1")
version=$(sed -n '/^\[workspace.package\]/,/^$/s/^version = "\(.*\)"/\1/p' Cargo.toml)
target=$(rustc -vV | sed -n 's/^host: //p')
profile=${NIGHTSPLAT_PROFILE:-release}
built=${CARGO_TARGET_DIR:-target}/$([ "$profile" = dev ] && echo debug || echo "$profile")

[ -z "$(git status --porcelain)" ] || { echo "there are uncommitted changes; commit them" >&2; exit 1; }
[ -n "$untagged" ] || git tag --points-at HEAD | grep -qx "v$version" || {
    echo "this commit has no tag v$version; tag it, or rehearse with --untagged" >&2
    exit 1
}

# The changes of this version; before it is dated, those under `Unreleased`.
notes() {
    awk -v version="$version" '/^## /{ours = index($0, version)} ours && !/^## /' CHANGELOG.md
}
notes | grep -q . || { echo "CHANGELOG.md says nothing of $version" >&2; exit 1; }
notes > "$out/NOTES.md"

echo "the program"
CARGO_PROFILE_RELEASE_STRIP=symbols cargo build --locked --profile "$profile" --bin nightsplat
scripts/package.sh "$target" "$built/nightsplat"
cp "dist/nightsplat-$version-$target.tar.gz" "$out/"

echo "the C library"
scripts/package-capi.sh "$target"
cp "dist/nightsplat-capi-$version-$target.tar.gz" "$out/"

echo "the crates"
scripts/package-crate.sh
cp dist/nightsplat*.crate "$out/"
cargo publish --workspace --dry-run --no-verify --locked --allow-dirty

echo "the Python package"
# For every Python from 3.9 on, and what this machine's C library allows: the workflow's is for glibc 2.28.
tools=$(mktemp -d)
trap 'rm -rf "$tools"' EXIT
python3 -m venv "$tools"
"$tools/bin/pip" install --quiet maturin==1.16.0
"$tools/bin/maturin" build --quiet --locked --strip --profile "$profile" --compatibility linux --out "$out" \
    --manifest-path crates/python/Cargo.toml

(cd "$out" && sha256sum ./*.tar.gz ./*.crate ./*.whl > SHA256SUMS)
scripts/test-release.sh "$out"
echo "$out is ready: push the tag v$version, and the release workflow builds and publishes the same for every platform"
