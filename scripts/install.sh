#!/usr/bin/env bash
# Installs gateway, recorder and router as systemd services, or brings an installation up to date (`make install`). The
# router is not enabled: few fleets need one.
#
#   /opt/swiftbot/releases/ID              the program (from locks/gateway.txt), its units and its page
#   /opt/swiftbot/current, previous        links to the release that runs and the one before
#   /usr/local/lib/systemd, sysusers.d, tmpfiles.d, /usr/local/bin/swiftbot, /usr/local/share/man    links into `current`
#   /etc/swiftbot/gateway.toml             only where there is none yet
#
# A release is laid out beside the others and switched to by one rename: killed or without power at any moment, this leaves
# the old release or the new one, whole (appliance/deploy/layout.py).
#
# DESTDIR=folder lays the same files out there, for a package: nothing on this machine is changed then.
# WITHOUT_ENVIRONMENT=1 leaves out the program itself.
set -euo pipefail
umask 022
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

DESTDIR=${DESTDIR:-}
OPT=$DESTDIR/opt/swiftbot
UNITS=(swiftbot-gateway.service swiftbot-recorder.service)
# There when it is wanted: `systemctl enable --now swiftbot-router`.
OPTIONAL=(swiftbot-router.service swiftbot-foxglove.service)

say() { echo "[install] $*"; }
die() {
  echo "[install] FAILED: $1" >&2
  echo "    remedy: $2" >&2
  exit 1
}

if [ -z "$DESTDIR" ]; then
  [ -n "$AS_ROOT" ] || die "this needs root" "sudo make install (or DESTDIR=folder to lay the files out there)"
  "$PROJECT/scripts/setup.sh" host
fi

layout() {
  PYTHONPATH=$PROJECT PYTHONDONTWRITEBYTECODE=1 /usr/bin/python3 -m appliance.deploy.layout --root "${DESTDIR:-/}" --tree "$PROJECT" "$@"
}

# The lock of `swiftbot upgrade`: each removes what it finds half laid out, and that may be what the other is laying out.
# Descriptor 9 is none of what `as_user` starts; the mode keeps other users from holding it.
mkdir -p "$OPT"
umask 077
exec 9>"$OPT/.lock"
umask 022
flock -n 9 || die "another upgrade, rollback or installation is running" "wait until it ends, then: sudo make install"
if [ -e "$OPT/upgrade.json" ]; then
  die "an upgrade was interrupted" "sudo swiftbot upgrade --resume finishes it, sudo swiftbot rollback goes back; then: sudo make install"
fi
wheels=
staged=$(layout --stage) || exit 1
trap 'rm -rf "$staged" ${wheels:+"$wheels"}' EXIT
if [ -z "${WITHOUT_ENVIRONMENT:-}" ]; then
  uv=$TOOLS/bin/uv
  [ -x "$uv" ] || die "$uv is not there" "run 'make setup' first"
  export UV_SYSTEM_CERTS=1 UV_NO_PROGRESS=1
  if [ -n "$AS_ROOT" ]; then export UV_CACHE_DIR=$STATE/cache; fi
  unset VIRTUAL_ENV PYTHONPATH UV_PYTHON
  wheels=$(mktemp -d)
  say "building the package"
  (cd "$PROJECT" && "$TOOLS/bin/python" -c 'import sys; from hatchling.build import build_wheel; build_wheel(sys.argv[1])' "$wheels")
  say "program"
  # Relocatable: it gets its name once it is whole.
  "$uv" venv --quiet --relocatable --python /usr/bin/python3 "$staged/venv"
  lock=gateway # WITH_FOXGLOVE=1: with the package of the live view; kept once it is there
  if [ -n "${WITH_FOXGLOVE:-}" ] || compgen -G "$OPT/current/venv/lib/python3*/site-packages/foxglove" >/dev/null; then lock=foxglove; fi
  "$uv" pip sync --quiet --require-hashes --compile-bytecode --python "$staged/venv/bin/python" "$PROJECT/locks/$lock.txt" ||
    die "the packages of locks/$lock.txt" "see the lines above; network, proxy and certificates are the usual reasons"
  "$uv" pip install --quiet --no-deps --no-index --compile-bytecode --python "$staged/venv/bin/python" "$wheels"/*.whl
  "$staged/venv/bin/swiftbot" manual "$staged/man" || die "the manual pages" "see the lines above"
fi

say "release and units"
id=$(uname -n | tr '[:upper:]' '[:lower:]' | tr -cd 'a-z0-9_-' | cut -c1-63)
layout --staged "$staged" --name "${id:-gateway}" || exit 1
if [ -z "$DESTDIR" ]; then
  # The same as in tmpfiles.d: closed to others, since keys and passwords of links may stand in it.
  chown "root:$RUN_USER" /etc/swiftbot
  chmod 0750 /etc/swiftbot
fi
# The user's own podman.socket, enabled as `systemctl --user enable` would, running or not.
home=$DESTDIR$([ -n "$DESTDIR" ] && echo /var/lib/swiftbot || echo "$BASE")
wants=$home/.config/systemd/user/sockets.target.wants
if [ ! -L "$wants/podman.socket" ]; then
  mkdir -p "$wants"
  ln -s /usr/lib/systemd/user/podman.socket "$wants/podman.socket"
  if [ -z "$DESTDIR" ]; then chown -R "$RUN_USER:" "$home/.config"; fi
fi
if [ -n "$DESTDIR" ]; then
  layout --prune
  rm -f "$OPT/.lock" # no part of a package
  say "laid out under $DESTDIR"
  exit 0
fi

locate_runtime_dir || die "there is no user $RUN_USER" "see what 'scripts/setup.sh host' says"
say "images"
(cd / && as_user /opt/swiftbot/current/venv/bin/swiftbot images build) | sed -u 's/^/    /' ||
  die "images" "see the lines above; then: sudo make install"

if [ ! -d /run/systemd/system ]; then
  layout --prune
  say "installed; systemd does not run here, so nothing is started"
  exit 0
fi
systemd-sysusers "$OPT/current/systemd/sysusers.d/swiftbot.conf"
systemd-tmpfiles --create "$OPT/current/systemd/tmpfiles.d/swiftbot.conf"
systemctl daemon-reload
# A manager of this user that runs already started with less delegated: told, since restarting it ends containers.
if ! grep -qs cpu "/sys/fs/cgroup/user.slice/user-$(id -u "$RUN_USER").slice/user@$(id -u "$RUN_USER").service/cgroup.controllers"; then
  say "container limits take effect after a reboot, or: systemctl restart user@$(id -u "$RUN_USER")"
fi
systemctl enable --quiet "${UNITS[@]}" swiftbot-upgrade.service
say "starting (running services drain first)"
systemctl restart "${UNITS[@]}" ||
  die "the services did not start" "journalctl -u swiftbot-gateway -u swiftbot-recorder -n 50"
systemctl try-restart "${OPTIONAL[@]}" || say "one did not come back: journalctl -u swiftbot-router -u swiftbot-foxglove -n 50"
# Only now: until here the services may run from a release that neither `current` nor `previous` names any more.
layout --prune
# What installations before releases have left there; nothing that runs needs it now.
rm -rf "$OPT/venv" "$OPT/docs" "$OPT/LICENSE"
say "running: systemctl status ${UNITS[*]}"
