#!/usr/bin/env bash
# Installs gateway, recorder and router as systemd services, or brings an installation up to date (`make install`). The
# router is not enabled: few fleets need one.
#
#   /opt/swiftbot/venv                     the program, from locks/gateway.txt
#   /usr/local/lib/systemd, sysusers.d, tmpfiles.d
#   /etc/swiftbot/gateway.toml             only where there is none yet
#
# DESTDIR=folder lays the same files out there, for a package: nothing on this machine is changed then.
# WITHOUT_ENVIRONMENT=1 leaves out /opt/swiftbot/venv.
set -euo pipefail
umask 022
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

DESTDIR=${DESTDIR:-}
OPT=$DESTDIR/opt/swiftbot
LIB=$DESTDIR/usr/local/lib
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

if [ -z "${WITHOUT_ENVIRONMENT:-}" ]; then
  uv=$TOOLS/bin/uv
  [ -x "$uv" ] || die "$uv is not there" "run 'make setup' first"
  export UV_SYSTEM_CERTS=1 UV_NO_PROGRESS=1
  if [ -n "$AS_ROOT" ]; then export UV_CACHE_DIR=$STATE/cache; fi
  unset VIRTUAL_ENV PYTHONPATH UV_PYTHON
  wheels=$(mktemp -d)
  trap 'rm -rf "$wheels"' EXIT
  say "building the package"
  (cd "$PROJECT" && "$TOOLS/bin/python" -c 'import sys; from hatchling.build import build_wheel; build_wheel(sys.argv[1])' "$wheels")
  say "program: $OPT/venv"
  mkdir -p "$OPT"
  # Relocatable: what is laid out under DESTDIR runs from /opt.
  "$uv" venv --quiet --allow-existing --relocatable --python /usr/bin/python3 "$OPT/venv"
  lock=gateway # WITH_FOXGLOVE=1: with the package of the live view; kept once it is there
  if [ -n "${WITH_FOXGLOVE:-}" ] || compgen -G "$OPT/venv/lib/python3*/site-packages/foxglove" >/dev/null; then lock=foxglove; fi
  "$uv" pip sync --quiet --require-hashes --compile-bytecode --python "$OPT/venv/bin/python" "$PROJECT/locks/$lock.txt" ||
    die "the packages of locks/$lock.txt" "see the lines above; network, proxy and certificates are the usual reasons"
  "$uv" pip install --quiet --no-deps --no-index --reinstall --compile-bytecode --python "$OPT/venv/bin/python" "$wheels"/*.whl
  install -d "$DESTDIR/usr/local/bin"
  ln -sfn /opt/swiftbot/venv/bin/swiftbot "$DESTDIR/usr/local/bin/swiftbot"
fi

say "units"
for unit in "${UNITS[@]}" "${OPTIONAL[@]}"; do
  install -D -m 0644 "$PROJECT/systemd/$unit" "$LIB/systemd/system/$unit"
done
install -D -m 0755 "$PROJECT/systemd/system-generators/swiftbot-generator" "$LIB/systemd/system-generators/swiftbot-generator"
install -D -m 0644 "$PROJECT/systemd/sysusers.d/swiftbot.conf" "$LIB/sysusers.d/swiftbot.conf"
install -D -m 0644 "$PROJECT/systemd/tmpfiles.d/swiftbot.conf" "$LIB/tmpfiles.d/swiftbot.conf"
install -D -m 0644 "$PROJECT/docs/operations.md" "$OPT/docs/operations.md"
install -D -m 0644 "$PROJECT/LICENSE" "$OPT/LICENSE"

config=$DESTDIR/etc/swiftbot/gateway.toml
if [ -e "$config" ]; then
  say "configuration: $config is kept"
else
  id=$(uname -n | tr '[:upper:]' '[:lower:]' | tr -cd 'a-z0-9_-' | cut -c1-63)
  say "configuration: $config, gateway '${id:-gateway}'"
  install -d -m 0755 "$(dirname "$config")"
  sed "s/@ID@/${id:-gateway}/" "$PROJECT/systemd/gateway.toml" >"$config"
  chmod 0644 "$config"
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
  say "laid out under $DESTDIR"
  exit 0
fi

locate_runtime_dir || die "there is no user $RUN_USER" "see what 'scripts/setup.sh host' says"
say "images"
(cd / && as_user /opt/swiftbot/venv/bin/swiftbot images build) | sed -u 's/^/    /' ||
  die "images" "see the lines above; then: sudo make install"

if [ ! -d /run/systemd/system ]; then
  say "installed; systemd does not run here, so nothing is started"
  exit 0
fi
systemd-sysusers "$LIB/sysusers.d/swiftbot.conf"
systemd-tmpfiles --create "$LIB/tmpfiles.d/swiftbot.conf"
systemctl daemon-reload
# A manager of this user that runs already started with less delegated: told, since restarting it ends containers.
if ! grep -qs cpu "/sys/fs/cgroup/user.slice/user-$(id -u "$RUN_USER").slice/user@$(id -u "$RUN_USER").service/cgroup.controllers"; then
  say "container limits take effect after a reboot, or: systemctl restart user@$(id -u "$RUN_USER")"
fi
systemctl enable --quiet "${UNITS[@]}"
say "starting (running services drain first)"
systemctl restart "${UNITS[@]}" ||
  die "the services did not start" "journalctl -u swiftbot-gateway -u swiftbot-recorder -n 50"
systemctl try-restart "${OPTIONAL[@]}" || say "one did not come back: journalctl -u swiftbot-router -u swiftbot-foxglove -n 50"
say "running: systemctl status ${UNITS[*]}"
