#!/usr/bin/env bash
# Runs a command as the user that the appliance runs as, with its environment, in the folder that it is called in, so that
# relative paths mean what they say; from within the project in the same place of the tree that this user can read:
#   scripts/as_user.sh CMD [ARG...]
# Exit status, signals and the terminal are the command's own. `scripts/setup.sh` must have run before.
set -eu
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

if [ $# -eq 0 ]; then
  echo "usage: scripts/as_user.sh CMD [ARG...]" >&2
  exit 2
fi
if ! locate_runtime_dir; then
  echo "as_user: there is no user '$RUN_USER' (run 'make setup' first)" >&2
  exit 5
fi
HERE=$PWD
case $HERE/ in
  "$PROJECT"/*)
    if ! cd "$TREE" 2>/dev/null; then
      echo "as_user: $TREE is not there (run 'make setup' first)" >&2
      exit 5
    fi
    cd "./${HERE#"$PROJECT"}" 2>/dev/null || true
    ;;
  *)
    if ! (cd / && as_user test -x "$HERE" -a -r "$HERE"); then
      echo "as_user: $RUN_USER cannot read $HERE: call it from another folder, and give absolute paths" >&2
      exit 5
    fi
    ;;
esac
umask 022
exec_as_user "$@"
