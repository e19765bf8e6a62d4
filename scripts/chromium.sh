#!/usr/bin/env bash
# Install the browser in which tests open the page, Debian's or Ubuntu's chromium, where it is missing and this user may.
set -euo pipefail
! command -v chromium chromium-browser google-chrome || exit 0
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
    echo "chromium is missing, and this user cannot install it (Debian: apt install chromium)"
    exit 1
fi
apt-get update -qq
DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium
