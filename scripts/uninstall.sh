#!/usr/bin/env bash
# Takes the services out again (`make uninstall`). Configuration, tasks, logs, images and the user stay, unless
# PURGE=1. DESTDIR=folder: takes them out of there, and changes nothing on this machine.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

DESTDIR=${DESTDIR:-}
LIB=$DESTDIR/usr/local/lib
UNITS=(swiftbot-gateway.service swiftbot-recorder.service swiftbot-router.service swiftbot-foxglove.service
  swiftbot-upgrade.service run-swiftbot.mount)

say() { echo "[uninstall] $*"; }

if [ -z "$DESTDIR" ] && [ -z "$AS_ROOT" ]; then
  echo "[uninstall] FAILED: this needs root" >&2
  echo "    remedy: sudo make uninstall" >&2
  exit 1
fi

if [ -z "$DESTDIR" ] && [ -d /run/systemd/system ]; then
  for unit in "${UNITS[@]}"; do
    if systemctl cat "$unit" >/dev/null 2>&1; then
      say "stopping $unit (it drains first)"
      systemctl disable --quiet --now "$unit" || true
    fi
  done
fi
if [ -z "$DESTDIR" ] && locate_runtime_dir && [ -d "$RUNTIME_DIR" ] && command -v podman >/dev/null; then
  # A stopped gateway leaves its warm containers for the next start; there will be none.
  containers=$(cd / && as_user podman ps --all --quiet --filter label=swiftbot.gateway 2>/dev/null) || containers=
  if [ -n "$containers" ]; then
    say "removing containers"
    # shellcheck disable=SC2086
    (cd / && as_user podman rm --force --time 0 $containers) >/dev/null
  fi
fi

say "units and program"
# Links into the release that runs, and the files that installations before releases have left there.
for unit in "${UNITS[@]}"; do rm -f "$LIB/systemd/system/$unit"; done
rm -f "$LIB/systemd/system-generators/swiftbot-generator" "$LIB/sysusers.d/swiftbot.conf" "$LIB/tmpfiles.d/swiftbot.conf"
for place in "$LIB"/systemd/system "$LIB"/systemd/system-generators "$LIB"/sysusers.d "$LIB"/tmpfiles.d "$DESTDIR"/usr/local/bin \
  "$DESTDIR"/usr/local/share/man/man1; do
  if [ -d "$place" ]; then find "$place" -maxdepth 1 -type l -lname '*opt/swiftbot/*' -delete; fi
done
rm -rf "$DESTDIR/opt/swiftbot"
if [ -z "$DESTDIR" ] && [ -d /run/systemd/system ]; then systemctl daemon-reload; fi

if [ "${PURGE:-}" != 1 ]; then
  say "kept: $DESTDIR/etc/swiftbot, $DESTDIR/var/lib/swiftbot, the user $SERVICE_USER (PURGE=1 removes them too)"
  exit 0
fi
say "purging configuration, data and user"
rm -rf "$DESTDIR/etc/swiftbot"
if [ -n "$DESTDIR" ]; then
  rm -rf "$DESTDIR/var/lib/swiftbot"
  exit 0
fi
if locate_runtime_dir; then
  if [ -d "$RUNTIME_DIR" ] && command -v podman >/dev/null; then (cd / && as_user podman system reset --force) >/dev/null 2>&1 || true; fi
  if command -v loginctl >/dev/null && [ -d /run/systemd/system ]; then
    loginctl disable-linger "$RUN_USER" || true
    systemctl stop "user@$RUN_UID.service" || true
  elif [ -f "$RUNTIME_DIR/swiftbot-podman.pid" ] && grep -qs podman "/proc/$(cat "$RUNTIME_DIR/swiftbot-podman.pid")/cmdline"; then
    kill "$(cat "$RUNTIME_DIR/swiftbot-podman.pid")" || true
  fi
  rm -rf "$BASE"
  userdel "$RUN_USER" || say "the user $RUN_USER could not be removed: it still has processes"
fi
