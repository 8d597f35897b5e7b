#!/usr/bin/env bash
# Makes this machine able to run the appliance, from nothing but git, make and Python 3.11 on Debian.
#
#   scripts/setup.sh [gateway|dev|host] [--without-images] [--with-browser] [--with-prometheus] [--with-ray] [--with-flower] [--with-train] [--with-docs]
#
# gateway: what a gateway and the demo need. dev: that, and the tools of `make test`. host: only the machine's part
# (packages, user, ranges, Podman), for `make install`, which puts the program elsewhere. --with-browser: also Chromium
# (300 MB), for the test of the terminal UI in a browser; where it cannot be had, that test says so. --with-prometheus:
# likewise Prometheus' programs (19 MB), for the test of the dashboard; no service of it is started. --with-ray: Ray, which
# benchmarks compare with; --with-flower: Flower, likewise (5 GB); --with-train: also PyTorch, for `swiftbot train`;
# --with-docs: MkDocs; each in an environment of its own.
# As root it sets up the service user and works for it; as a user it works in place and asks sudo for system packages
# and id ranges only. What is there already is kept: a second run takes about a second. docs/operations.md tells more.
set -euo pipefail
umask 022
START=$(date +%s%N)
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

MODE=gateway
IMAGES=1
WITH_BROWSER=
WITH_PROMETHEUS=
WITH_RAY=
WITH_FLOWER=
WITH_TRAIN=
WITH_DOCS=
for argument in "$@"; do
  case $argument in
    gateway | dev | host) MODE=$argument ;;
    --without-images) IMAGES= ;;
    --with-browser) WITH_BROWSER=1 ;;
    --with-prometheus) WITH_PROMETHEUS=1 ;;
    --with-ray) WITH_RAY=1 ;;
    --with-flower) WITH_FLOWER=1 ;;
    --with-train) WITH_TRAIN=1 ;;
    --with-docs) WITH_DOCS=1 ;;
    *)
      echo "setup: unknown argument '$argument' (usage: scripts/setup.sh [gateway|dev|host] [--without-images] [--with-browser] [--with-prometheus] [--with-ray] [--with-flower] [--with-train] [--with-docs])" >&2
      exit 2
      ;;
  esac
done

PACKAGES=("${GATEWAY_PACKAGES[@]}")
[ "$MODE" = dev ] && PACKAGES+=(systemd iproute2 tmux groff-base)  # for tests: network namespaces, the UI in a terminal, manual pages
# Gateways and recorders go by their clocks. What keeps them already is left alone, but for systemd-timesyncd, which chrony
# replaces: it follows a clock that drifts, and tells how far off it is.
keeps_time() { dpkg-query -W -f='${db:Status-Status}\n' chrony ntpsec ntp openntpd 2>/dev/null | grep -qx installed; }
if [ "$MODE" = host ] && ! keeps_time; then PACKAGES+=(chrony); fi
API_STALE=
RANGE=65536           # ids that a rootless container may use
NEED_FRESH_MB=4000    # environment, its downloads, images: measured 2.6 GB, and room to work
NEED_AGAIN_MB=300
CERTIFICATES=/etc/ssl/certs/ca-certificates.crt

LOG=$(mktemp "${TMPDIR:-/tmp}/swiftbot-setup.XXXXXX")
SCRATCH=
trap 'rm -rf "$LOG" ${SCRATCH:+"$SCRATCH"}' EXIT

elapsed() {
  local ms=$((($(date +%s%N) - START) / 1000000))
  printf '%d.%d' $((ms / 1000)) $((ms % 1000 / 100))
}
say() { printf '[setup %6ss] %s\n' "$(elapsed)" "$*"; }

# fail STEP REMEDY: the end, with the last lines of what went wrong and what to do about it.
fail() {
  local step=$1 remedy=$2
  {
    printf '[setup %6ss] FAILED: %s\n' "$(elapsed)" "$step"
    if [ -s "$LOG" ]; then tail -n 15 "$LOG" | sed 's/^/    | /'; fi
    if grep -qiE 'no space left|disk quota' "$LOG"; then
      remedy="the disk is full: free some space (df -h), then run it again"
    elif grep -qiE 'certificate verify|unknownissuer|self.signed certificate|certificate_unknown' "$LOG"; then
      remedy="a certificate is not trusted: put your organisation's CA into /usr/local/share/ca-certificates, run update-ca-certificates, then run it again"
    elif grep -qiE 'could not resolve|temporary failure|name or service not known|network is unreachable|no route to host|connection (timed out|refused)|dns error|failed to fetch|unable to connect' "$LOG"; then
      remedy="no network: check the connection, and http_proxy/https_proxy where a proxy is needed, then run it again"
    fi
    printf '    remedy: %s\n' "$remedy"
  } >&2
  exit 1
}

trap 'fail "scripts/setup.sh, line $LINENO: $BASH_COMMAND" "this should not happen: please report it with the lines above"' ERR

# quiet STEP REMEDY CMD...: runs it with its output kept for the case that it fails.
quiet() {
  local step=$1 remedy=$2
  shift 2
  "$@" >"$LOG" 2>&1 9>&- </dev/null || fail "$step" "$remedy"
}

# root STEP CMD...: runs it as root, through sudo for an ordinary user.
root() {
  local step=$1
  shift
  if [ -n "$AS_ROOT" ]; then
    quiet "$step" "see the lines above" "$@"
    return
  fi
  if ! command -v sudo >/dev/null; then
    : >"$LOG"
    fail "$step" "this needs root, and there is no sudo here: run 'make setup' once as root, or install sudo"
  fi
  if ! sudo -n true 2>/dev/null && ! { [ -t 0 ] && sudo -v; }; then
    : >"$LOG"
    fail "$step" "this needs root, and sudo refused: run 'sudo -v' first, or 'make setup' once as root"
  fi
  quiet "$step" "see the lines above" sudo env "http_proxy=${http_proxy:-}" "https_proxy=${https_proxy:-}" \
    "no_proxy=${no_proxy:-}" DEBIAN_FRONTEND=noninteractive "$@"
}

digest() { cat "$@" | sha256sum | cut -c1-64; }

# --- checks ------------------------------------------------------------------------------------------------

check_system() {
  : >"$LOG"
  command -v apt-get >/dev/null && command -v dpkg-query >/dev/null ||
    fail "this is not Debian" "the appliance is set up on Debian 12 or later, or a system made from it"
  local folder=$BASE need=$NEED_FRESH_MB free
  [ -e "$STATE/environment" ] && need=$NEED_AGAIN_MB
  while [ ! -d "$folder" ]; do folder=$(dirname "$folder"); done
  free=$(df -Pm "$folder" | awk 'NR == 2 { print $4 }')
  [ "$free" -ge "$need" ] ||
    fail "$folder has $free MB free, $need MB are needed" "free some space (df -h $folder), then run it again"
}

# --- steps -------------------------------------------------------------------------------------------------

install_packages() {
  local installed package
  local -a missing=()
  installed=" $(dpkg-query -W -f='${db:Status-Status}:${Package} ' "${PACKAGES[@]}" 2>/dev/null || true)"
  for package in "${PACKAGES[@]}"; do
    [[ $installed == *" installed:$package "* ]] || missing+=("$package")
  done
  if [ ${#missing[@]} -eq 0 ]; then return; fi
  say "system packages: installing ${missing[*]}"
  export DEBIAN_FRONTEND=noninteractive
  # One unreachable extra source is no reason to stop: only a package that cannot be had is.
  (root "apt-get update" apt-get -q -o DPkg::Lock::Timeout=120 update) 2>/dev/null || say "system packages: apt-get update had errors; going on"
  root "system packages: ${missing[*]}" apt-get -q -y -o DPkg::Lock::Timeout=300 -o Acquire::Retries=3 \
    install --no-install-recommends "${missing[@]}"
  say "system packages: done"
}

# For one test: a machine without it is set up all the same.
install_browser() {
  if [ -z "$WITH_BROWSER" ] || command -v chromium >/dev/null; then return; fi
  say "chromium: installing it"
  (root "chromium" apt-get -q -y -o DPkg::Lock::Timeout=300 -o Acquire::Retries=3 install --no-install-recommends chromium) ||
    say "chromium: could not be had; going on"
}

# The same. Taken out of its package: installed, it would run as a service.
take_prometheus() {
  local out=$VENV/bin folder
  if [ -z "$WITH_PROMETHEUS" ] || command -v prometheus >/dev/null || [ -x "$out/prometheus" ]; then return; fi
  say "prometheus: taking it out of Debian's package"
  folder=$(mktemp -d "$STATE/prometheus.XXXXXX")
  if (cd "$folder" && apt-get -q -o Acquire::Retries=3 -o APT::Sandbox::User=root download prometheus && dpkg-deb -x prometheus_*.deb .) >"$LOG" 2>&1; then
    install -m 0755 "$folder/usr/bin/prometheus" "$folder/usr/bin/promtool" "$out/"
  else
    say "prometheus: could not be had; going on"
  fi
  rm -rf "$folder"
}

check_python() {
  : >"$LOG"
  /usr/bin/python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    fail "/usr/bin/python3 is $(/usr/bin/python3 -V 2>&1), 3.11 or later is needed" "use Debian 12 or later"
}

make_user() {
  if [ -n "$AS_ROOT" ] && ! getent passwd "$RUN_USER" >/dev/null; then
    say "service user: creating $RUN_USER"
    quiet "service user $RUN_USER" "create it by hand: see sysusers.d in systemd/" useradd --system --user-group \
      --home-dir "$BASE" --create-home --shell /usr/sbin/nologin "$RUN_USER"
  fi
  if [ -n "$AS_ROOT" ]; then
    if [ ! -d "$BASE" ] || [ "$(stat -c %U "$BASE")" != "$RUN_USER" ]; then
      quiet "home of $RUN_USER" "check $BASE" install -d -m 0755 -o "$RUN_USER" -g "$(id -g "$RUN_USER")" "$BASE"
    fi
    install -d -m 0755 "$STATE"
    install -d -m 0755 -o "$RUN_USER" -g "$(id -g "$RUN_USER")" "$STATE/pycache"
  else
    mkdir -p "$STATE/pycache"
  fi
  locate_runtime_dir
}

# First id of a range that overlaps no range of anybody's in either file.
free_range() {
  cat /etc/subuid /etc/subgid 2>/dev/null | awk -F: -v want="$RANGE" '
    BEGIN { start = 100000 }
    NF == 3 { n++; first[n] = $2; last[n] = $2 + $3 }
    END {
      do {
        moved = 0
        for (i = 1; i <= n; i++)
          if (first[i] < start + want && last[i] > start) { start = last[i]; moved = 1 }
      } while (moved)
      print start
    }'
}

give_ranges() {
  local kind start= added=
  for kind in uid gid; do
    if ! grep -qsE "^($RUN_USER|$RUN_UID):" "/etc/sub$kind"; then
      start=${start:-$(free_range)}
      say "id ranges: $RUN_USER gets $start-$((start + RANGE - 1)) in /etc/sub$kind"
      root "id range in /etc/sub$kind" usermod "--add-sub${kind}s" "$start-$((start + RANGE - 1))" "$RUN_USER"
      added=1
    fi
  done
  if [ -n "$added" ] && [ -d "$USER_HOME/.local/share/containers" ]; then
    (cd / && as_user podman system migrate) >/dev/null 2>&1 || true  # tells a running Podman of the new ranges
  fi
}

systemd_runs() { [ -d /run/systemd/system ]; }

make_runtime_dir() {
  if [ -n "$AS_ROOT" ] && systemd_runs && command -v loginctl >/dev/null && [ ! -e "/var/lib/systemd/linger/$RUN_USER" ]; then
    say "service user: lingering, so that its services run without a login"
    loginctl enable-linger "$RUN_USER" >"$LOG" 2>&1 || say "service user: no linger ($(tail -n 1 "$LOG"))"
    local tries=0
    while [ ! -d "$RUNTIME_DIR" ] && [ $((tries += 1)) -le 50 ]; do sleep 0.1; done
  fi
  if [ ! -d "$RUNTIME_DIR" ]; then
    root "$RUNTIME_DIR" install -d -m 0755 "$(dirname "$RUNTIME_DIR")"
    root "$RUNTIME_DIR" install -d -m 0700 -o "$RUN_USER" -g "$(id -g "$RUN_USER")" "$RUNTIME_DIR"
  fi
}

# Whether the kernel lets this user mount overlayfs itself: faster than FUSE, and needs no /dev/fuse.
native_overlay() {
  as_user /bin/sh -c '
    folder=$(mktemp -d) && trap "rm -rf \"$folder\"" EXIT && cd "$folder" && mkdir lower upper work merged && : >lower/file &&
    unshare --user --map-root-user --mount sh -c \
      "mount -t overlay overlay -o lowerdir=lower,upperdir=upper,workdir=work,userxattr merged && rm merged/file" &&
    { chmod -R u+rwx work || true; }' >/dev/null 2>&1
}

# user_file PATH TEXT: writes a file of the working user's that is not there yet.
user_file() {
  local file=$1
  (cd / && as_user mkdir -p "$(dirname "$file")" && printf '%s' "$2" | as_user tee "$file") >/dev/null 2>"$LOG" ||
    fail "writing $file" "check who owns $USER_HOME/.config"
}

configure_storage() {
  local file=$USER_HOME/.config/containers/storage.conf options=
  if [ -e "$file" ]; then return; fi
  if (cd / && native_overlay); then
    say "storage: overlay by the kernel"
  else
    say "storage: overlay by fuse-overlayfs"
    [ -e /dev/fuse ] || say "storage: /dev/fuse is missing, containers will not start (modprobe fuse, or give it to this machine)"
    options=$'[storage.options.overlay]\nmount_program = "/usr/bin/fuse-overlayfs"\n'
  fi
  user_file "$file" $'[storage]\ndriver = "overlay"\n'"$options"
}

# Podman before 4.4 takes its OCI runtime from here only; crun, its default, refuses cgroup v1 in hybrid mode.
configure_engine() {
  local file=$USER_HOME/.config/containers/containers.conf engine= containers= text=
  if [ -e "$file" ]; then return; fi
  if [ "$(stat -fc %T /sys/fs/cgroup 2>/dev/null)" != cgroup2fs ]; then
    engine+=$'runtime = "runc"\n'
  elif ! grep -qsw pids /sys/fs/cgroup/cgroup.controllers; then
    # Podman would ask for its default limit of processes, and containers would not start at all.
    containers+=$'pids_limit = 0\n'
  fi
  if ! systemd_runs; then engine+=$'cgroup_manager = "cgroupfs"\nevents_logger = "file"\n'; fi
  if [ -n "$containers" ]; then text+=$'[containers]\n'$containers; fi
  if [ -n "$engine" ]; then text+=$'[engine]\n'$engine; fi
  if [ -z "$text" ]; then return; fi
  say "podman: $(printf '%s' "$engine$containers" | tr '\n' ';') in containers.conf"
  user_file "$file" "$text"
  API_STALE=1  # a service that runs already has read the old configuration
}

copy_tree() {
  [ "$PROJECT" = "$TREE" ] && return
  local staging owner=$RUN_USER:$(id -g "$RUN_USER")
  local -a modes=("--chown=$owner" "--chmod=Du=rwx,Dgo=rx,Fu+rw,Fgo+r")
  : >"$LOG"
  install -d -m 0755 -o "$RUN_USER" -g "$(id -g "$RUN_USER")" "$BASE/work" "$TREE"
  staging=$(mktemp -d "$BASE/work/.staging.XXXXXX")
  if command -v git >/dev/null && git -c safe.directory='*' -C "$PROJECT" ls-files -co --exclude-standard -z >"$LOG.files" 2>"$LOG"; then
    rsync -a --from0 --files-from="$LOG.files" --ignore-missing-args "$PROJECT/" "$staging/" >"$LOG" 2>&1 || fail "copying the tree" "see the lines above"
  else
    # rsync does not know the "!" of .gitignore: what it takes back is named here.
    rsync -a --exclude=/.git --include='/tests/replay/logs/**.mcap' --filter=':- .gitignore' "$PROJECT/" "$staging/" >"$LOG" 2>&1 || fail "copying the tree" "see the lines above"
  fi
  rm -f "$LOG.files"
  rsync -a --delete --exclude=/.hypothesis --exclude=/.ruff_cache "${modes[@]}" "$staging/" "$TREE/" >"$LOG" 2>&1 ||
    fail "copying the tree to $TREE" "see the lines above"
  rm -rf "$staging"
}

make_tools() {
  local want
  want=$(digest "$PROJECT/locks/tools.txt")
  if [ -x "$TOOLS/bin/uv" ] && [ "$(cat "$STATE/tools" 2>/dev/null)" = "$want" ]; then return; fi
  say "tools: uv, hatchling"
  quiet "tools: virtual environment" "apt-get install python3-venv" /usr/bin/python3 -m venv --clear "$TOOLS"
  quiet "tools: uv" "see the lines above" "$TOOLS/bin/python" -m pip install --quiet --disable-pip-version-check \
    --require-hashes --no-deps --only-binary :all: -r "$PROJECT/locks/tools.txt"
  echo "$want" >"$STATE/tools"
}

# The environment holds exactly what the lock says. It is never taken down from dev to gateway: dev contains gateway.
make_environment() {
  local lock=$MODE have want python
  have=$(cat "$STATE/environment" 2>/dev/null || true)
  if [ "$MODE" = gateway ] && { [[ $have == dev* ]] || [ -x "$VENV/bin/pytest" ]; }; then lock=dev; fi
  if [ -e "$VENV/bin/python" ] && "$VENV/bin/python" -IS -c '' 2>/dev/null; then
    python=$(readlink -f "$VENV/bin/python")
  else
    make_tools
    say "environment: creating $VENV"
    local -a keep=()
    [ -n "$AS_ROOT" ] || keep=(--allow-existing)
    quiet "environment: $VENV" "remove $VENV and run it again" "$TOOLS/bin/uv" venv --quiet ${keep[@]+"${keep[@]}"} --python /usr/bin/python3 "$VENV"
    python=$(readlink -f "$VENV/bin/python")
  fi
  # Compiled here: who runs it may not write there, and compiling what MAVLink needs at each start takes 0.5 s and 60 MB.
  want="$lock compiled $python $(digest "$PROJECT/locks/$lock.txt")"
  if [ "$have" != "$want" ]; then
    make_tools
    say "environment: packages of locks/$lock.txt"
    rm -f "$STATE/package"  # the package is not in the lock, so a sync takes it out
    # Builds of packages without a wheel leave a lock file in the folder for temporary files: they get their own.
    SCRATCH=$(mktemp -d "$STATE/tmp.XXXXXX")
    quiet "environment: packages" "see the lines above" env "TMPDIR=$SCRATCH" "$TOOLS/bin/uv" pip sync --quiet --require-hashes \
      --compile-bytecode --python "$VENV/bin/python" "$PROJECT/locks/$lock.txt"
    echo "$want" >"$STATE/environment"
    say "environment: done"
  fi
}

# Ray and Flower are for measurements alone, and larger than most of the rest: the product's own environment stays
# without them.
make_ray() { make_apart ray "$RAY" locks/bench.txt bin/ray; }
make_flower() { make_apart flower "$FLOWER" locks/flower.txt bin/flower-superlink; }
make_train() { make_apart train "$TRAIN" locks/train.txt bin/torchrun; }
make_docs() { make_apart docs "$DOCS" locks/docs.txt bin/mkdocs; }

# make_apart NAME FOLDER LOCK PROOF: an environment beside the program's own; PROOF is a file that it has when it is whole.
make_apart() {
  local name=$1 folder=$2 lock=$3 proof=$4 want
  want=$(digest "$PROJECT/$lock")
  if [ -x "$folder/$proof" ] && [ "$(cat "$STATE/$name" 2>/dev/null)" = "$want" ]; then return; fi
  make_tools
  say "$name: packages of $lock"
  quiet "$name: $folder" "remove $folder and run it again" "$TOOLS/bin/uv" venv --quiet --clear --python /usr/bin/python3 "$folder"
  SCRATCH=$(mktemp -d "$STATE/tmp.XXXXXX")  # as above: not every package has a wheel
  quiet "$name: packages" "see the lines above" env "TMPDIR=$SCRATCH" "$TOOLS/bin/uv" pip sync --quiet --require-hashes \
    --python "$folder/bin/python" "$PROJECT/$lock"
  echo "$want" >"$STATE/$name"
  say "$name: done"
}

# Product and workshop, each as a pointer to the tree ("editable"), built without network.
install_package() {
  local want wheels part
  want="$TREE $(digest "$PROJECT/pyproject.toml" "$PROJECT/workshop/pyproject.toml" "$PROJECT/README.md")"
  if [ -x "$VENV/bin/swiftbot" ] && [ "$(cat "$STATE/package" 2>/dev/null)" = "$want" ]; then return; fi
  make_tools
  say "package: swiftbot command"
  wheels=$(cd / && as_user mktemp -d /tmp/swiftbot-wheel.XXXXXX)
  for part in . workshop; do
    (cd "$TREE/$part" && quiet "package: build $part" "see the lines above" as_user "$TOOLS/bin/python" -c \
      'import sys; from hatchling.build import build_editable; build_editable(sys.argv[1])' "$wheels") || exit 1
  done
  quiet "package: install" "see the lines above" "$TOOLS/bin/uv" pip install --quiet --no-deps --no-index --reinstall \
    --python "$VENV/bin/python" "$wheels"/*.whl
  rm -rf "$wheels"
  echo "$want" >"$STATE/package"
}

# Asks Podman's API for a sign of life through the socket.
api_answers() {
  [ -S "$API_SOCKET" ] || return 1
  (cd / && as_user /usr/bin/python3 -IS - "$API_SOCKET" <<'PYTHON'
import socket, sys
with socket.socket(socket.AF_UNIX) as s:
    s.settimeout(5)
    s.connect(sys.argv[1])
    s.sendall(b"GET /_ping HTTP/1.0\r\nHost: d\r\n\r\n")
    sys.exit(b" 200 " not in s.recv(64))
PYTHON
  ) 2>/dev/null
}

# Where /run outlives the processes (a restored machine, or all of the user's processes killed at once), Podman believes
# that its containers still run, and looks for a pause process that is gone. It says itself what mends that.
mend_podman() {
  grep -q 'podman system migrate' "$LOG" || return 1
  say "podman: it has lost its pause process; resetting it"
  (cd / && as_user podman system migrate && as_user podman info) >"$LOG" 2>&1
}

podman_remedy() {
  if grep -qi 'cannot clone' "$LOG"; then
    echo "user namespaces are not permitted here: sysctl kernel.unprivileged_userns_clone=1 user.max_user_namespaces=15000; no chroot; in a container, one that may nest containers"
  elif grep -qi 'uidmap' "$LOG"; then
    echo "see that $RUN_USER has a range in /etc/subuid and /etc/subgid, and that newuidmap is setuid root (apt-get install --reinstall uidmap)"
  elif grep -qi cgroup "$LOG"; then
    echo "the machine must have cgroups mounted: v2, or v1 with a writable hierarchy"
  else
    echo "try it by hand: scripts/as_user.sh podman info"
  fi
}

start_api() {
  if [ -z "$API_STALE" ] && api_answers; then return; fi
  say "podman: starting the API socket $API_SOCKET"
  local pidfile=$RUNTIME_DIR/swiftbot-podman.pid apilog=$RUNTIME_DIR/swiftbot-podman.log pid tries=0
  : >"$LOG"
  (cd / && as_user podman info) >"$LOG" 2>&1 || mend_podman || fail "podman does not work for user $RUN_USER" "$(podman_remedy)"
  if systemd_runs && [ -S "$RUNTIME_DIR/systemd/private" ]; then
    (cd / && quiet "podman.socket" "look at: journalctl --user -u podman.socket" as_user systemctl --user enable --now podman.socket) || exit 1
    # A socket file that lost its listener is made again; a service ends by itself and starts with the next request.
    { [ -z "$API_STALE" ] && api_answers; } || (cd / && quiet "podman.socket" "look at: journalctl --user -u podman.socket" as_user systemctl --user restart podman.socket podman.service) || exit 1
  else
    pid=$(cat "$pidfile" 2>/dev/null || true)
    if [ -n "$pid" ] && grep -qs podman "/proc/$pid/cmdline"; then kill "$pid" 2>/dev/null || true; fi
    (cd / && as_user mkdir -p "$(dirname "$API_SOCKET")" && as_user rm -f "$API_SOCKET") >"$LOG" 2>&1 || fail "podman: $API_SOCKET" "check who owns $RUNTIME_DIR"
    # shellcheck disable=SC2016
    (cd / && as_user setsid -f /bin/sh -c 'echo $$ >"$1"; exec podman system service --time=0 "unix://$2" >"$3" 2>&1' \
      sh "$pidfile" "$API_SOCKET" "$apilog") </dev/null >/dev/null 2>&1
  fi
  while ! api_answers; do
    if [ $((tries += 1)) -gt 100 ]; then
      cat "$apilog" >"$LOG" 2>/dev/null || true
      fail "podman: the API socket does not answer" "run as the service user: scripts/as_user.sh podman system service --time=0"
    fi
    sleep 0.1
  done
}

# Built once for each content of the image definitions; looked for in Podman each time, since storage may be reset.
build_images() {
  local want have
  want=$(cd "$TREE" && find appliance/skills appliance/pool -type f \( -name '*.toml' -o -name 'Containerfile*' -o -name 'requirements.txt' -o -name 'images.py' -o -name 'wheels.py' -o -name 'catalogue.py' \) -print0 | LC_ALL=C sort -z | xargs -0 sha256sum | sha256sum | cut -c1-64)
  have=$(cat "$STATE/images" 2>/dev/null || true)
  if [ "$have" = "$want $(image_ids)" ]; then return; fi
  say "images: building what is missing"
  : >"$LOG"
  (cd "$TREE" && as_user swiftbot images build) </dev/null 2>&1 | tee "$LOG" | sed -u 's/^/    /' ||
    fail "images" "look at the lines above; then: scripts/as_user.sh swiftbot images build"
  echo "$want $(image_ids)" >"$STATE/images"
  say "images: done"
}

image_ids() { (cd / && as_user podman images --quiet --no-trunc --filter 'reference=localhost/swiftbot/*' 2>/dev/null | LC_ALL=C sort | tr '\n' ' '); }

# --- all of it ---------------------------------------------------------------------------------------------

# The system's certificates and proxies, for pip and uv as for everything else.
export UV_SYSTEM_CERTS=1 UV_NO_PROGRESS=1 PIP_NO_INPUT=1
if [ -n "$AS_ROOT" ]; then export UV_CACHE_DIR=$STATE/cache; fi
unset PIP_REQUIRE_VIRTUALENV PIP_USER PIP_TARGET PIP_PREFIX UV_PYTHON VIRTUAL_ENV PYTHONPATH PYTHONHOME

check_system
mkdir -p "$([ -n "$AS_ROOT" ] && echo /run/lock || echo "$BASE")"
exec 9>"$([ -n "$AS_ROOT" ] && echo /run/lock/swiftbot-setup.lock || echo "$BASE/.setup.lock")"
if ! flock -n 9; then
  say "waiting for another setup to end"
  flock -w 900 9 || fail "another setup is running" "wait for it, or end it"
fi
install_packages
install_browser
if [ -z "${PIP_CERT:-}" ] && [ -e "$CERTIFICATES" ]; then export PIP_CERT=$CERTIFICATES; fi
check_python
make_user
give_ranges
make_runtime_dir
configure_storage
configure_engine
if [ "$MODE" = host ]; then
  make_tools
  start_api
else
  copy_tree
  make_environment
  take_prometheus
  install_package
  start_api
  if [ -n "$IMAGES" ]; then build_images; fi
  if [ -n "$WITH_RAY" ]; then make_ray; fi
  if [ -n "$WITH_FLOWER" ]; then make_flower; fi
  if [ -n "$WITH_TRAIN" ]; then make_train; fi
  if [ -n "$WITH_DOCS" ]; then make_docs; fi
fi
say "ready ($MODE, user $RUN_USER)"
