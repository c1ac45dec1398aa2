# Times the stages of the script that sources it, and prints them at its end, slowest first.

stages=()
stage=

# begin NAME: the stage of what follows, up to the next one.
begin() {
    [ -z "$stage" ] || stages+=("$(printf '%6d s  %s' "$((SECONDS - began))" "$stage")")
    stage=$1 began=$SECONDS
    [ -z "$stage" ] || printf '\n== %s\n' "$stage"
}

print_stages() {
    begin ""
    echo
    printf '%s\n' "${stages[@]}" | sort -rn
    printf '%6d s  in all\n' "$SECONDS"
}
trap print_stages EXIT
