#!/usr/bin/env bash
# Makes the figures and tables of this folder from its CSV files; --check says which differ.
set -euo pipefail
cd "$(dirname "$0")/.."
exec python -m results.make "$@"
