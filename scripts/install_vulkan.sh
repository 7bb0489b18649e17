#!/usr/bin/env bash
# Install what the simulator needs to render without a GPU: the Vulkan loader and Mesa's software driver, 24 or newer.
# For Debian 12 and newer and Ubuntu 24.04 and newer; run as root or with sudo at hand. Running it twice does no harm.
# Ends with 0 where the driver is there, else with 1 and a sentence that says what is missing.
set -Eeuo pipefail
export LC_ALL=C # what apt says is read below

oldest=24
package=mesa-vulkan-drivers
system=${INSTALL_VULKAN_SYSTEM:-} # stands before /etc and /usr; empty but in tests

say() { echo "install_vulkan: $*"; }
stop() { say "$*" >&2; exit 1; }
trap 'say "ended early: line $LINENO, \`$BASH_COMMAND\`, status $?" >&2' ERR

without="or leave this script out: the tests that render images are then skipped"
[ -r "$system/etc/os-release" ] || stop "cannot tell which system this is (no /etc/os-release);" \
  "install a Mesa Vulkan driver >= $oldest manually, $without"
# shellcheck source=/dev/null
. "$system/etc/os-release"
case " ${ID:-} ${ID_LIKE:-} " in
  *" debian "* | *" ubuntu "*) ;;
  *) stop "this is ${PRETTY_NAME:-an unknown system}, neither Debian nor Ubuntu;" \
    "install a Mesa Vulkan driver >= $oldest manually, $without" ;;
esac
shopt -s inherit_errexit # not before: the bash of other systems may be too old to know it

# Prints the version of a package that is installed, and nothing of one that is not.
installed() {
  local shown status=0
  shown=$(dpkg-query -W -f='${db:Status-Abbrev} ${Version}\n' "$1" 2>&1) || status=$?
  case $status in
    0) awk '$1 == "ii" && !seen++ { print $2 }' <<<"$shown" ;;
    1) ;; # dpkg has never heard of it
    *) stop "dpkg-query cannot tell whether $1 is installed: $shown" ;;
  esac
}

# Prints the version that apt would install now; nothing where no package source has one.
candidate() {
  local shown
  shown=$(apt-cache policy "$package")
  awk '$1 == "Candidate:" && $2 != "(none)" { print $2 }' <<<"$shown"
}

# Whether the major part of a Debian version such as 1:25.0.7-2~bpo12+1 is new enough.
recent() {
  local version=${1#*:}
  version=${version%%[!0-9]*}
  [ -n "$version" ] && [ "$version" -ge "$oldest" ]
}

update() { "${as_root[@]}" apt-get update -q; }

have=$(installed "$package")
loader=$(installed libvulkan1)
if recent "$have" && [ -n "$loader" ]; then
  say "$package $have is installed already"
  exit 0
fi

user=$(id -u)
if [ "$user" -eq 0 ]; then
  as_root=()
elif command -v sudo >/dev/null; then
  as_root=(sudo)
else
  stop "$package is ${have:-not installed}; installing it needs root: run this script as root, or install sudo"
fi
say "$package is ${have:-not installed}, $oldest or newer is needed: installing it"
update || stop "apt-get update failed, its reason is above; mend that and run this script again"

offered=$(candidate)
target=()
if [ -z "$offered" ]; then
  stop "no package source offers $package. Where apt-get warns above that it could not fetch something, mend that;" \
    "else add the main archive of ${PRETTY_NAME:-this release} to /etc/apt, and run this script again"
elif ! recent "$offered"; then
  [ "${ID:-}" = debian ] && [ -n "${VERSION_CODENAME:-}" ] ||
    stop "${PRETTY_NAME:-this release} offers $package $offered; $oldest or newer is needed (Ubuntu 24.04 has it)"
  suite="$VERSION_CODENAME-backports"
  # One line for each package source: address, codename, component.
  sources=$(apt-get indextargets --format '$(REPO_URI) $(CODENAME) $(COMPONENT)' 'Created-By: Packages')
  if [ -z "$(awk -v suite="$suite" '$2 == suite' <<<"$sources")" ]; then
    mirror=$(awk -v suite="$VERSION_CODENAME" '$2 == suite && $3 == "main" && !seen++ { print $1 }' <<<"$sources")
    [ -n "$mirror" ] || stop "found no package source of $VERSION_CODENAME to take $suite from; add $suite manually"
    list="/etc/apt/sources.list.d/$suite.list"
    keys=/usr/share/keyrings/debian-archive-keyring.gpg
    option=""
    [ ! -r "$system$keys" ] || option="[signed-by=$keys] "
    say "adding $suite in $list, since $VERSION_CODENAME has $offered"
    echo "deb $option$mirror $suite main" | "${as_root[@]}" tee "$system$list" >/dev/null
    if ! update; then
      "${as_root[@]}" rm -f "$system$list" # else every apt-get update of this machine would fail from now on
      stop "apt-get update failed with $suite of $mirror, its reason is above; $list is gone again"
    fi
  fi
  target=(-t "$suite")
fi
"${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
  apt-get install -y -q --no-install-recommends "${target[@]}" libvulkan1 "$package" ||
  stop "apt-get install failed, its reason is above; mend that and run this script again"

have=$(installed "$package")
recent "$have" || stop "$package is ${have:-not installed} after all; $oldest or newer is needed"
say "$package $have is installed"
