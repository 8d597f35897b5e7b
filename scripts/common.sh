# Where things are, for the other scripts (sourced, never run).
#
# Two ways to work, told apart by who runs them:
#  root:   everything that runs, runs as the unprivileged service user, in a copy of the tree that this user can
#          read (the checkout may lie in a folder closed to it) and in a virtual environment owned by root.
#  a user: everything runs as that user, in place; only system packages and id ranges need sudo.

PROJECT=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
SERVICE_USER=swiftbot
# Debian packages that a gateway needs.
GATEWAY_PACKAGES=(podman runc crun uidmap slirp4netns fuse-overlayfs catatonit dbus-user-session mmdebstrap
  python3 python3-venv rsync ca-certificates)

if [ "$(id -u)" -eq 0 ]; then
  AS_ROOT=1
  RUN_USER=$SERVICE_USER
  BASE=$(getent passwd "$RUN_USER" | cut -d: -f6) || true
  BASE=${BASE:-/var/lib/swiftbot}
  USER_HOME=$BASE
  VENV=$BASE/venv
  TOOLS=$BASE/tools
  RAY=$BASE/ray
  TRAIN=$BASE/train
  FLOWER=$BASE/flower
  DOCS=$BASE/docs
  TREE=$BASE/work/swiftbot
  STATE=$BASE/setup
else
  AS_ROOT=
  RUN_USER=$(id -un)
  BASE=$PROJECT/.venv
  USER_HOME=$HOME
  VENV=$BASE
  TOOLS=$BASE/.tools
  RAY=$BASE/.ray
  TRAIN=$BASE/.train
  FLOWER=$BASE/.flower
  DOCS=$BASE/.docs
  TREE=$PROJECT
  STATE=$BASE/.setup
fi

# Sets RUN_UID, RUNTIME_DIR, API_SOCKET; call it once the user exists.
locate_runtime_dir() {
  RUN_UID=$(id -u "$RUN_USER" 2>/dev/null) || return 1
  RUNTIME_DIR=/run/user/$RUN_UID
  if [ -z "$AS_ROOT" ] && [ -n "${XDG_RUNTIME_DIR:-}" ] && [ -w "$XDG_RUNTIME_DIR" ]; then
    RUNTIME_DIR=$XDG_RUNTIME_DIR
  fi
  API_SOCKET=$RUNTIME_DIR/podman/podman.sock
}

# Becomes the working user and runs "$@" in the current process: signals, terminal and exit status are its own.
# (`runuser` would stay between, and kill with SIGKILL two seconds after SIGTERM.)
exec_as_user() {
  local -a become=() environment
  if [ -n "$AS_ROOT" ]; then
    become=(setpriv "--reuid=$RUN_USER" "--regid=$(id -g "$RUN_USER")" --init-groups --inh-caps=-all --)
  fi
  environment=(
    -u XDG_CONFIG_HOME -u XDG_DATA_HOME -u XDG_CACHE_HOME -u XDG_STATE_HOME -u DBUS_SESSION_BUS_ADDRESS
    -u PYTHONPATH -u PYTHONHOME -u PYTHONSTARTUP -u PYTHONDONTWRITEBYTECODE -u PYENV_VERSION
    -u CONTAINER_HOST -u DOCKER_HOST -u MAKEFLAGS -u MAKELEVEL -u MFLAGS
    "HOME=$USER_HOME" "USER=$RUN_USER" "LOGNAME=$RUN_USER" SHELL=/bin/bash
    "XDG_RUNTIME_DIR=$RUNTIME_DIR"
    "PATH=$VENV/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
    "VIRTUAL_ENV=$VENV" "LANG=${LANG:-C.UTF-8}"
    # Compiled modules are kept, but outside the tree and the environment.
    "PYTHONPYCACHEPREFIX=$STATE/pycache"
  )
  [ -z "$AS_ROOT" ] || environment=(-u TMPDIR -u TMP -u TEMP "${environment[@]}")
  [ ! -S "$RUNTIME_DIR/bus" ] || environment+=("DBUS_SESSION_BUS_ADDRESS=unix:path=$RUNTIME_DIR/bus")
  exec ${become[@]+"${become[@]}"} env "${environment[@]}" "$@"
}

# The same in a child process, for use in the middle of a script. Descriptor 9 is setup's lock: not theirs to keep.
as_user() { (exec_as_user "$@") 9>&-; }
