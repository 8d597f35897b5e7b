#!/usr/bin/env bash
# Runs the whole test suite, then those that failed once more by themselves, and says which they were.
#
# Thousands of tests with real containers, radios and deadlines share two cores with whatever else the machine does, and
# one of them that was late once would hide what all the others have shown. The second run is short, and has the machine
# for itself; a test that fails in it as well fails the suite. Properties are tried with the same examples in both runs,
# so that a counterexample that was found by chance is not lost by chance.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)

run() { "$here/as_user.sh" "$@"; }
memory=$(run mktemp -d --tmpdir swiftbot-suite.XXXXXX) # of which tests failed
trap 'run rm -rf "$memory"' EXIT
suite() { run "${PYTHON:-python}" -m pytest -o "cache_dir=$memory" "--hypothesis-seed=$seed" "$@"; }

seed=$RANDOM
status=0
suite "$@" || status=$?
# 1: tests failed; anything else is a run that did not come to its end.
[ "$status" = 1 ] || exit "$status"
run test -e "$memory/v/cache/lastfailed" || {
    echo 'The run was ended by a test that stood still: the stacks above say where.' >&2
    exit 1
}
printf '\nThese failed and are run once more, by themselves:\n'
run cat "$memory/v/cache/lastfailed"
printf '\n'
suite --last-failed --last-failed-no-failures none "$@"
printf '\nAll passed, those above at the second run only: each of them is to be looked into.\n'
