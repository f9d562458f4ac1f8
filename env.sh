# Source me (bash): puts the virtual environment and the built workspace on this shell.
#     . ./env.sh
# Where a Jazzy distribution is sourced it stays the underlay; otherwise the wheels are.
_cc_root="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
if [ ! -f "$_cc_root/.venv/bin/activate" ] || [ ! -f "$_cc_root/ros_ws/install/local_setup.bash" ]; then
    echo "Crash Coach is not set up yet: run 'make setup' in $_cc_root" >&2
    unset _cc_root
    return 1
fi
. "$_cc_root/.venv/bin/activate"
if [ "${ROS_DISTRO:-}" = jazzy ]; then
    # The distribution's own Python runs `ros2 launch`, which reads our launch files.
    for _cc_site in "$VIRTUAL_ENV"/lib/python3.*/site-packages; do
        export PYTHONPATH="${PYTHONPATH:+$PYTHONPATH:}$_cc_site"
    done
    unset _cc_site
else
    case ":${AMENT_PREFIX_PATH:-}:" in
        *":$VIRTUAL_ENV:"*) ;;
        *) export AMENT_PREFIX_PATH="$VIRTUAL_ENV${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}" ;;
    esac
fi
. "$_cc_root/ros_ws/install/local_setup.bash"
# One thread per process: a second run is a better use of a second core.
# The same kernels of OpenBLAS and torch on every machine with AVX2: a seed then trains the same team on all of them.
if grep -qw avx2 /proc/cpuinfo; then
    export OPENBLAS_CORETYPE="${OPENBLAS_CORETYPE:-Haswell}" ATEN_CPU_CAPABILITY="${ATEN_CPU_CAPABILITY:-avx2}"
fi
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE
export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
unset _cc_root
