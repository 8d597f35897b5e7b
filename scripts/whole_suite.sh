#!/usr/bin/env bash
# whole_suite.sh [-m MARKS] PATH...: runs tests, then those of real processes that failed once more by themselves.
#
# Tests of fleets, with real containers, links and deadlines, share two cores with whatever else the machine does, and
# one of them that was late once would hide what all the others have shown. They (marked `fleet`) get a second run, which
# is short and has the machine for itself; a test that fails in it as well fails the suite, and so does any other test
# that failed. Properties are tried with the same examples in every run, so that what passed on one machine passes on the
# next, and a counterexample comes again; `make check` draws new ones, and so does SWIFTBOT_SEED=$RANDOM here.
# Tests in tests/integration and tests/security, which mostly wait, run in three processes, each a file at a time, others in
# two, but for those marked `alone`, which run after them one after another. Of these the slowest are listed.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
marks=
[ "${1:-}" != -m ] || { marks=$2 && shift 2; }

run() { "$here/as_user.sh" "$@"; }
memory=$(run mktemp -d --tmpdir swiftbot-suite.XXXXXX) # of which tests failed
trap 'run rm -rf "$memory"' EXIT
suite() { run "${PYTHON:-python}" -m pytest -o "cache_dir=$memory" "--hypothesis-seed=$seed" "$@"; }

seed=${SWIFTBOT_SEED:-1}
apart=() together=()
for path in "$@"; do
    case $path in *integration* | *security*) apart+=("$path") ;; *) together+=("$path") ;; esac
done
failed=0
first() {
    local status=0 marked=$1
    shift
    suite -m "$marked" "$@" || status=$?
    # 1: tests failed; 5: none is marked so; anything else is a run that did not come to its end.
    case $status in 0 | 5) ;; 1) failed=1 ;; *) exit "$status" ;; esac
}
[ ${#together[@]} = 0 ] || first "$marks" --numprocesses 2 --dist worksteal "${together[@]}"
[ ${#apart[@]} = 0 ] || {
    first "${marks:+($marks) and }not alone" --numprocesses 3 --dist loadfile --durations=40 "${apart[@]}"
    first "${marks:+($marks) and }alone" --durations=20 "${apart[@]}"
}
[ "$failed" = 1 ] || exit 0
run test -e "$memory/v/cache/lastfailed" || {
    echo 'The run was ended by a test that stood still: the stacks above say where.' >&2
    exit 1
}
printf '\nThese failed:\n'
run cat "$memory/v/cache/lastfailed"
again=(--last-failed --last-failed-no-failures none)
status=0
suite "${again[@]}" -m 'not fleet' --collect-only -q "$@" || status=$?
[ "$status" = 5 ] || {
    printf '\nThose above start no fleet: they are not run a second time.\n' >&2
    exit 1
}
printf '\nThose that start a fleet are run once more, by themselves:\n'
suite "${again[@]}" "$@"
printf '\nAll passed, those above at the second run only: each of them is to be looked into.\n'
