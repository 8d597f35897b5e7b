#!/usr/bin/env bash
# Runs a command as the user that the appliance runs as, in the tree that this user can read, with its environment:
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
if ! cd "$TREE" 2>/dev/null; then
  echo "as_user: $TREE is not there (run 'make setup' first)" >&2
  exit 5
fi
umask 022
exec_as_user "$@"
