# SPDX-License-Identifier: Apache-2.0
# Source this file (bash or zsh): `. ./setup.bash`. It puts the executables of smp_motor_control, its Python and the ROS
# that `make setup` chose into this shell. It changes nothing else: which hosts discover each other stays your choice.

_smp_source() {
  local root=$1 shell=$2 bin lib
  if [ ! -f "$root/.venv/ready" ]; then
    echo "setup.bash: not set up yet; run: make -C '$root' setup" >&2
    return 1
  fi
  # The first line of the file names the ROS installation that was found, or is empty where the wheels are used.
  local prefix
  IFS= read -r prefix < "$root/.venv/ready" || true
  if [ -n "$prefix" ]; then
    case ":${AMENT_PREFIX_PATH:-}:" in *":$prefix:"*) ;; *) . "$prefix/setup.$shell" ;; esac
  else
    # The wheels' libraries; said here, their Python need not start itself a second time to find them.
    for lib in "$root"/.venv/lib "$root"/.venv/lib/python3.*/site-packages/ros_*.libs; do
      case ":${LD_LIBRARY_PATH:-}:" in
        *":$lib:"*) ;;
        *) export LD_LIBRARY_PATH="$lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}" ;;
      esac
    done
    case ":${AMENT_PREFIX_PATH:-}:" in
      *":$root/.venv:"*) ;;
      *) export AMENT_PREFIX_PATH="$root/.venv${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}" ;;
    esac
    export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
  fi
  . "$root/install/local_setup.$shell" || return
  for bin in "$root/.venv/bin" "$root/install/smp_motor_control/lib/smp_motor_control"; do
    case ":$PATH:" in *":$bin:"*) ;; *) PATH="$bin:$PATH" ;; esac
  done
  export PATH VIRTUAL_ENV="$root/.venv"
}

if [ -n "${ZSH_VERSION:-}" ]; then
  eval '_smp_root=${${(%):-%x}:A:h}'
  _smp_shell=zsh
else
  _smp_root=$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")" && pwd -P)
  _smp_shell=bash
fi
# The set-up files of ROS and colcon read unset variables.
_smp_options=$-
set +u
_smp_source "$_smp_root" "$_smp_shell"
_smp_status=$?
case $_smp_options in *u*) set -u ;; esac
unset -f _smp_source
unset _smp_root _smp_shell _smp_options
# shellcheck disable=SC2317
eval "unset _smp_status; return $_smp_status"
