#!/usr/bin/env bash
# Runs the tests on SwiftShader, the software device that comes with Debian's chromium: subgroups of four, and no push
# descriptors. Arguments go to `cargo test`:
#     scripts/test-on-swiftshader.sh --test sort --test render
# What fails there is named in scripts/swiftshader-failures.txt, with the reason. A failure that is not named, and a named one
# that passes, are failures of this script.
set -uo pipefail
cd "$(dirname "$0")/.."
driver=${SWIFTSHADER_ICD:-/usr/lib/chromium/vk_swiftshader_icd.json}
if [ ! -e "$driver" ]; then
    echo "not run: the tests on SwiftShader, as there is no $driver (on Debian \`apt install chromium\`)"
    exit 0
fi
# Older loaders know the second name alone.
export VK_DRIVER_FILES=$driver VK_ICD_FILENAMES=$driver

log=$(mktemp)
trap 'rm -f "$log"' EXIT
cargo test --no-fail-fast "$@" 2>&1 | tee "$log"
if ! grep -q '^test result' "$log"; then
    echo "failed: no test ran"
    exit 1
fi

# Each test that ran with what became of it, be it the test's own word or the validation layer's at the end of the process.
outcomes() {
    sed -n 's/^test \(.*\) \.\.\. \(ok\|FAILED\)$/\2 \1/p' "$log"
    sed -n '/^validation failed in$/,/^ *Running /s/^\([a-z0-9_:]*\): .*/FAILED \1/p' "$log"
}
failed=$(outcomes | sed -n 's/^FAILED //p' | sort -u)
named=$(sed 's/ *#.*//; /^$/d' scripts/swiftshader-failures.txt | sort -u)
ran=$(outcomes | cut -d ' ' -f 2- | sort -u)
unnamed=$(comm -23 <(echo "$failed") <(echo "$named"))
mended=$(comm -12 <(comm -13 <(echo "$failed") <(echo "$named")) <(echo "$ran"))
# A process that died leaves tests without an outcome.
died=$(grep -E 'process didn.t exit successfully.*signal' "$log")

status=0
for problem in "fails on SwiftShader and is not named:$unnamed" "is named but passes on SwiftShader:$mended" "died on SwiftShader:$died"; do
    if [ -n "${problem#*:}" ]; then
        echo "${problem%%:*}:" && echo "${problem#*:}" && status=1
    fi
done
if [ "$status" -eq 0 ]; then
    echo "on SwiftShader $(wc -w <<< "$ran") tests ran; those that fail are the $(grep -c . <<< "$failed") that are named"
fi
exit "$status"
