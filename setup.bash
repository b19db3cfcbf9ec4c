# Source this file to get a shell in which perch works:   source setup.bash
# It puts the virtual environment, the built workspace and every node's executable on the path.
# Made for bash; it needs a finished set-up (python3 scripts/setup.py, or any other script here).

case $- in *u*) _perch_nounset=1; set +u ;; esac  # activate and colcon read variables that are not set

_perch_root="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"

_perch_prepend() {  # NAME FOLDER: put FOLDER first in the path variable NAME, once
  local rest=":${!1-}:"
  rest="${rest//:$2:/:}"
  rest="${rest#:}"
  rest="${rest%:}"
  export "$1=$2${rest:+:$rest}"
}

_perch_end() {  # leave nothing of this file but the environment
  unset -f _perch_prepend _perch_end
  unset _perch_root _perch_folder _perch_byte
  if [ -n "${_perch_nounset:-}" ]; then unset _perch_nounset; set -u; fi
}

if [ ! -f "$_perch_root/.venv/bin/activate" ] ||
  { [ ! -f "$_perch_root/install/setup.bash" ] && [ -z "${PERCH_WITHOUT_WORKSPACE:-}" ]; }; then
  echo "perch is not set up yet: run   python3 $_perch_root/scripts/setup.py   and source this file again" >&2
  _perch_end
  return 1
fi

# Every socket of ROS is bound to this address (SECURITY.md). One that Fast DDS cannot read would open them all.
_perch_byte='(25[0-5]|2[0-4][0-9]|1?[0-9]?[0-9])'
if [[ ! "${PERCH_NETWORK:-127.0.0.1}" =~ ^($_perch_byte\.){3}$_perch_byte$ ]]; then
  echo "PERCH_NETWORK=$PERCH_NETWORK is not an address such as 127.0.0.1" >&2
  _perch_end
  return 1
fi

if [ -d "$_perch_root/.venv/share/rclpy" ] && [ "${RMW_IMPLEMENTATION:-rmw_fastrtps_cpp}" != rmw_fastrtps_cpp ]; then
  echo "RMW_IMPLEMENTATION=$RMW_IMPLEMENTATION: the ROS wheels have rmw_fastrtps_cpp only: run   unset RMW_IMPLEMENTATION" >&2
  _perch_end
  return 1
fi

# A workspace that was built with a ROS installation needs it also where it is not sourced yet.
if [ -z "${ROS_DISTRO:-}" ] && [ -f "$_perch_root/.perch/ros_prefix" ]; then
  source "$(cat "$_perch_root/.perch/ros_prefix")/setup.bash"
fi

source "$_perch_root/.venv/bin/activate"

# The ROS wheels look for their shared libraries beside themselves. Saying so here saves each
# Python a second start. A sourced ROS installation has done the same for itself.
if [ -d "$_perch_root/.venv/share/rclpy" ]; then
  for _perch_folder in "$_perch_root"/.venv/lib/python3*/site-packages/ros_*.libs "$_perch_root/.venv/lib"; do
    [ -d "$_perch_folder" ] && _perch_prepend LD_LIBRARY_PATH "$_perch_folder"
  done
  export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
  _perch_prepend AMENT_PREFIX_PATH "$_perch_root/.venv"
  _perch_prepend CMAKE_PREFIX_PATH "$_perch_root/.venv"
fi

if [ -z "${PERCH_WITHOUT_WORKSPACE:-}" ]; then  # set only while the workspace is being built
  source "$_perch_root/install/setup.bash"
fi

for _perch_folder in "$_perch_root"/install/perch_*/lib/perch_*; do
  [ -d "$_perch_folder" ] && _perch_prepend PATH "$_perch_folder"
done

export ROS_DOMAIN_ID="${ROS_DOMAIN_ID:-42}"
export PERCH_NETWORK="${PERCH_NETWORK:-127.0.0.1}"
export FASTRTPS_DEFAULT_PROFILES_FILE="${FASTRTPS_DEFAULT_PROFILES_FILE:-$_perch_root/config/fastdds.xml}"
# With our profile the address is the limit (LOCALHOST would add a socket on every interface); a file of the caller's own may have none,
# and another middleware does not read it.
if [ "$FASTRTPS_DEFAULT_PROFILES_FILE" = "$_perch_root/config/fastdds.xml" ] && [[ "${RMW_IMPLEMENTATION:-rmw_fastrtps_cpp}" == rmw_fastrtps_* ]]; then
  export ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET
else
  export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
fi
# The matrices here are small: threads inside numpy only take the cores from other nodes.
export OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1

_perch_end
