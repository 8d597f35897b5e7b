#!/bin/bash
# Records the logs that tests/replay replays: real runs of local fleets, without what nobody there looks at.
#
#     scripts/as_user.sh scripts/record_replay_logs.sh FOLDER [NAME...]
#
# FOLDER gets NAME.mcap for each run: normal, gateway-killed, partition, overload-migration (all by default). Look at
# them with `swiftbot log info`, then put those that are to be kept into tests/replay/logs/runs and name them in
# tests/replay/test_runs.py. A log is at most 300 KB: a repository keeps what it was given for good.
set -euo pipefail

out=${1:?folder for the logs}
shift
names=("$@")
[ ${#names[@]} -gt 0 ] || names=(normal gateway-killed partition overload-migration)
work=$(mktemp -d -t swiftbot-replay-XXXXXX)
trap 'rm -rf "$work"' EXIT
mkdir -p "$out"

chaos() {  # NAME OPTION...: a run of tasks with counted effects
  local name=$1
  shift
  swiftbot bench chaos --keep "$work/$name" --json "$@" >"$work/$name.json"
}

for name in "${names[@]}"; do
  case $name in
  normal) chaos normal --minutes 0.15 --every-s 0 --tasks 8 --gateways 3 --seed 11 ;;
  gateway-killed) chaos gateway-killed --minutes 0.3 --every-s 5 --freezes 0 --tasks 12 --gateways 3 --seed 12 ;;
  partition) chaos partition --faults partition --fault-s 10 --rest-s 5 --tasks 8 --gateways 4 --seed 13 ;;
  overload-migration)
    # A gateway whose pool is short of memory gives its runs away.
    python -m pytest -p no:cacheprovider -q tests/integration/tasks/test_migration.py -k short_of_memory \
      --basetemp "$work/$name.test" -o tmp_path_retention_policy=all >&2
    mkdir -p "$work/$name"
    cp -r "$(find "$work/$name.test" -type d -name record | head -n 1)" "$work/$name/record"
    ;;
  *)
    echo "no run $name: normal, gateway-killed, partition, overload-migration" >&2
    exit 2
    ;;
  esac
  rm -f "$out/$name.mcap"
  swiftbot log merge "$work/$name"/record/*.mcap --out "$work/$name.mcap" >/dev/null
  swiftbot log trim "$work/$name.mcap" --out "$out/$name.mcap" \
    --without '**/mavlink/**' --without '**/camera' --without 'swiftbot/*/recorder/*/robot/**' \
    --without 'swiftbot/*/recorder/*/log' --without 'swiftbot/*/recorder/*/status' --without '**/exchange/**' >/dev/null
  swiftbot log check "$out/$name.mcap"
  size=$(stat -c %s "$out/$name.mcap")
  echo "$out/$name.mcap: $size bytes"
  [ "$size" -le 300000 ] || { echo "$name is larger than 300 KB: make the run shorter" >&2; exit 1; }
done
