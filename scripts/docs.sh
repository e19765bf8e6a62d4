#!/usr/bin/env bash
# Build the documentation into out/site: the pages of this folder, and the reference that is written from the code.
# After `make packages` or `make`; `make docs` does all of it.
set -euo pipefail
. "$(dirname "$0")/common.sh"
. scripts/env.sh

if ! missing=$(python -c 'import material, mkdocs' 2>&1); then
    echo "${missing##*$'\n'}: the extra \`docs\` of setup.cfg is missing; type: scripts/setup.sh docs" >&2
    exit 1
fi
step reference "reference, from the code" python scripts/reference
rm -rf build/docs && mkdir -p build/docs
ln -s "$root"/{README,SECURITY,CONTRIBUTING}.md "$root"/{docs,examples} build/docs
NO_MKDOCS_2_WARNING=1 step site "documentation, into out/site" python -m mkdocs build --strict --quiet
