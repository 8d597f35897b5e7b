#!/usr/bin/env bash
# Makes a bundle: a release in one signed file, which `swiftbot upgrade` installs without a network (`make bundle`).
#
#   KEY=release.key [OUT=file] [MODELS="folder …"] [PARTS="file …"] scripts/bundle.sh
#
# KEY is a file that `swiftbot release key` made. In the bundle: the program and its packages as wheels (locks/gateway.txt,
# by hash), uv, units, the page of operations, the source, the container images that this machine has (a gateway builds
# those that are not in it), and the Debian packages that a gateway needs with all that those need, from this machine's apt
# sources. MODELS: folders of models for the planner, beside the one in the program. PARTS: signed lists of parts
# (`swiftbot parts sign`), one for each fleet that gets the bundle. WITHOUT_IMAGES=1 and WITHOUT_PACKAGES=1 leave these out.
# For the architecture, Debian release and Python of this machine.
set -euo pipefail
umask 022
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

say() { echo "[bundle] $*"; }
die() {
  echo "[bundle] FAILED: $1" >&2
  echo "    remedy: $2" >&2
  exit 1
}

KEY=${KEY:-}
[ -n "$KEY" ] || die "no key is named" "make bundle KEY=release.key; 'swiftbot release key release.key' makes one"
[ -r "$KEY" ] || die "$KEY cannot be read" "'swiftbot release key $KEY' makes one"
[ -x "$TOOLS/bin/python" ] && [ -x "$VENV/bin/python" ] || die "this tree is not set up" "make setup"
locate_runtime_dir || die "there is no user $RUN_USER" "make setup"
version=$(sed -n 's/^version = "\(.*\)"/\1/p' "$PROJECT/pyproject.toml" | head -n 1)
OUT=${OUT:-$PROJECT/dist/swiftbot-$version-$(uname -m).bundle}
mkdir -p "$(dirname "$OUT")"

work=$(mktemp -d "${TMPDIR:-/var/tmp}/swiftbot-bundle.XXXXXX")
trap 'rm -rf "$work"' EXIT
mkdir -p "$work/files/wheels" "$work/files/tools" "$work/files/source" "$work/files/docs" "$work/tools"
pip() { "$TOOLS/bin/python" -m pip --quiet --disable-pip-version-check "$@"; }
lock="see the lines above; network, proxy and certificates are the usual reasons"

say "program and source"
# The same tree makes the same wheel: hatchling takes times from SOURCE_DATE_EPOCH, and has a fixed one by itself.
for kind in wheel sdist; do
  [ "$kind" = wheel ] && to=$work/files/wheels || to=$work/files/source
  (cd "$PROJECT" && "$TOOLS/bin/python" -c \
    "import sys; from hatchling.build import build_$kind; build_$kind(sys.argv[1])" "$to") || die "the $kind" "see the lines above"
done
say "packages of locks/gateway.txt"
pip download --no-deps --require-hashes --only-binary :all: -d "$work/files/wheels" -r "$PROJECT/locks/gateway.txt" || die "the packages" "$lock"
pip download --no-deps --require-hashes --only-binary :all: -d "$work/tools" -r "$PROJECT/locks/tools.txt" || die "uv" "$lock"
cp "$work"/tools/uv-*.whl "$work/files/tools/"
cp -r "$PROJECT/systemd" "$work/files/systemd"
chmod 0755 "$work"/files/systemd/system-generators/*
cp "$PROJECT/docs/operations.md" "$work/files/docs/"
cp "$PROJECT/LICENSE" "$work/files/"

if [ -z "${WITHOUT_PACKAGES:-}" ]; then
  say "Debian packages"
  mkdir -p "$work/files/packages/partial" "$work/apt"
  : >"$work/status" # as on a machine that has none: what others lack is not known here
  # chrony besides: a machine whose clock nothing keeps gets it (scripts/setup.sh host).
  apt-get -q -y -o "Dir::State::status=$work/status" -o "Dir::Cache=$work/apt" -o "Dir::Cache::archives=$work/files/packages" \
    -o APT::Sandbox::User=root -o Debug::NoLocking=1 --no-install-recommends --download-only \
    install "${GATEWAY_PACKAGES[@]}" chrony >"$work/log" 2>&1 || {
    tail -n 5 "$work/log" >&2
    die "the Debian packages" "apt-get update, and look at the machine's apt sources; WITHOUT_PACKAGES=1 leaves them out"
  }
  rm -rf "$work/files/packages/partial" "$work/files/packages/lock"
  printf '%s\n' "${GATEWAY_PACKAGES[@]}" >"$work/files/packages/wanted"
fi
for model in ${MODELS:-}; do
  [ -d "$model" ] || die "$model is no folder of a model" "MODELS=\"folder …\""
  mkdir -p "$work/files/models"
  cp -rL "$model" "$work/files/models/"
done
number=0
for list in ${PARTS:-}; do
  mkdir -p "$work/files/parts"
  cp "$list" "$work/files/parts/$((number += 1)).json" || die "$list cannot be read" "swiftbot parts sign writes it"
done

if [ -z "${WITHOUT_IMAGES:-}" ]; then
  images=$(cd / && as_user podman images --quiet --no-trunc --filter 'reference=localhost/swiftbot/*' 2>/dev/null) || images=
  for image in $(printf '%s\n' "$images" | LC_ALL=C sort -u); do
    name=$(cd / && as_user podman image inspect --format '{{index .RepoTags 0}}' "$image")
    say "image $name"
    mkdir -p "$work/files/images"
    file=${name##*/}
    (cd / && as_user podman save --format oci-archive "$name") >"$work/files/images/${file//:/-}.tar" ||
      die "image $name" "swiftbot images build --force"
  done
  [ -d "$work/files/images" ] || say "no images here: the gateway builds them"
fi

say "packing and signing"
PYTHONPATH=$PROJECT PYTHONDONTWRITEBYTECODE=1 "$VENV/bin/python" -m appliance.cli release pack "$work/files" \
  --key "$KEY" --out "$OUT" --tree "$PROJECT"
