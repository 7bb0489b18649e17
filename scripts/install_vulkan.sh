#!/usr/bin/env bash
# Install what the simulator needs to render without a GPU: the Vulkan loader and Mesa's software driver, 24 or newer.
# For Debian 12 and newer and Ubuntu 24.04 and newer; run as root or with sudo at hand. Running it twice does no harm.
set -euo pipefail

oldest=24
package=mesa-vulkan-drivers

say() { echo "install_vulkan: $*"; }
stop() { say "$*" >&2; exit 1; }

as_root() {
  if [ "$(id -u)" -eq 0 ]; then
    "$@"
  elif command -v sudo >/dev/null; then
    sudo "$@"
  else
    stop "needs root: run it as root, or install sudo"
  fi
}

# Prints the major part of a Debian version such as 1:25.0.7-2~bpo12+1.
major() { local version=${1#*:}; echo "${version%%.*}"; }

installed() { dpkg-query -W -f='${db:Status-Abbrev} ${Version}' "$package" 2>/dev/null | awk '$1 == "ii" { print $2 }'; }

candidate() { apt-cache policy "$package" | awk '$1 == "Candidate:" && $2 != "(none)" { print $2 }'; }

# One line for each package source: address, codename, component.
sources() { apt-get indextargets --format '$(REPO_URI) $(CODENAME) $(COMPONENT)' 'Created-By: Packages'; }

recent() { [ -n "$1" ] && [ "$(major "$1")" -ge "$oldest" ]; }

[ -r /etc/os-release ] || stop "cannot tell which system this is; install $package >= $oldest by hand"
. /etc/os-release
case " ${ID:-} ${ID_LIKE:-} " in
  *" debian "* | *" ubuntu "*) ;;
  *) stop "this is ${PRETTY_NAME:-an unknown system}, neither Debian nor Ubuntu; install a Mesa Vulkan driver >= $oldest by hand" ;;
esac

have=$(installed)
if recent "$have" && dpkg-query -W -f='${db:Status-Abbrev}' libvulkan1 2>/dev/null | grep -q '^ii'; then
  say "$package $have is installed already"
  exit 0
fi

as_root apt-get update -q
target=()
if ! recent "$(candidate)"; then
  if [ "${ID:-}" = debian ] && [ -n "${VERSION_CODENAME:-}" ]; then
    suite="$VERSION_CODENAME-backports"
    if ! sources | awk -v suite="$suite" '$2 == suite { found = 1 } END { exit !found }'; then
      mirror=$(sources | awk -v suite="$VERSION_CODENAME" '$2 == suite && $3 == "main" { print $1; exit }')
      [ -n "$mirror" ] || stop "found no package source of $VERSION_CODENAME to take $suite from; add $suite by hand"
      say "adding $suite"
      keys=/usr/share/keyrings/debian-archive-keyring.gpg
      option=""
      [ ! -r "$keys" ] || option="[signed-by=$keys] "
      echo "deb $option$mirror $suite main" | as_root tee "/etc/apt/sources.list.d/$suite.list" >/dev/null
      as_root apt-get update -q
    fi
    target=(-t "$suite")
  else
    stop "${PRETTY_NAME:-this release} offers $package $(candidate); $oldest or newer is needed (Ubuntu 24.04 has it)"
  fi
fi
as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "${target[@]}" libvulkan1 "$package"

have=$(installed)
recent "$have" || stop "$package is ${have:-not installed} after all; $oldest or newer is needed"
say "$package $have is installed"
