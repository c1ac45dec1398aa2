#!/usr/bin/env bash
# Packs a built program for a release: scripts/package.sh TARGET BINARY writes dist/nightsplat-VERSION-TARGET.tar.gz
# (.zip for Windows) with completions, man pages, the licences of all crates, and its checksum. GLIBC is the newest glibc
# that the program may require (default: any); the required version is printed.
set -euo pipefail
cd "$(dirname "$0")/.."
target=${1:?name the target, such as x86_64-unknown-linux-gnu}
binary=${2:?name the built program}

version=$("$binary" --version | cut -d ' ' -f 2)
name=nightsplat-$version-$target
rm -rf "dist/$name"
mkdir -p "dist/$name/completions"
cp "$binary" README.md CHANGELOG.md LICENSE-APACHE LICENSE-MIT "dist/$name/"
# The linkers of the other systems strip where the profile says so.
case $target in
*-linux-*) strip "dist/$name/${binary##*/}" ;;
esac
# Of the crates of this platform.
scripts/licences.py --filter-platform "$target" > "dist/$name/LICENSES-THIRD-PARTY.txt"
"$binary" man "dist/$name/man/man1"
for shell in bash elvish fish powershell zsh; do
    "$binary" completions "$shell" > "dist/$name/completions/nightsplat.$shell"
done

# The glibc that a distribution must have; 2.17 is from 2012.
case $target in
*-linux-gnu)
    newest=$(objdump -T "$binary" | grep -o 'GLIBC_[0-9.]*' | sort -Vu | tail -1)
    echo "$name needs $newest"
    most=GLIBC_${GLIBC:-${newest#GLIBC_}}
    if [ "$(printf '%s\n' "$newest" "$most" | sort -V | tail -1)" != "$most" ]; then
        echo "$name must not need more than $most" >&2
        exit 1
    fi
    ;;
esac

cd dist
case $target in
*-windows-*)
    archive=$name.zip
    7z a -bso0 "$archive" "$name"
    ;;
*)
    archive=$name.tar.gz
    tar -czf "$archive" "$name"
    ;;
esac
if command -v sha256sum > /dev/null; then sha256sum "$archive"; else shasum -a 256 "$archive"; fi > "$archive.sha256"
cat "$archive.sha256"
