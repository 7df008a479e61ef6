"""A Slurm cluster of one node on this machine, for tests: munged, slurmctld and slurmd with all files in one folder."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

DAEMONS = ("munged", "slurmctld", "slurmd")
COMMANDS = ("sbatch", "srun", "squeue", "scancel", "scontrol", "sinfo")
PROCESSES = {*DAEMONS, "slurmscriptd", "slurmstepd"}
PREFIXES = ("SLURM", "SBATCH", "SRUN", "SALLOC", "SQUEUE", "SINFO", "SCANCEL")

# The smallest lifetime of a credential (s) that Slurm accepts; a requeued job waits one second longer than this.
CREDENTIAL_LIFETIME = 5
# Slurm writes its state to disk at most this often (s).
SAVE_INTERVAL = 5.0

CONFIGURATION = """\
ClusterName=tests
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller_port}
SlurmdPort={node_port}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
CredType=cred/munge
AuthInfo=socket={runtime}/munge.socket,cred_expire={credential_lifetime}
StateSaveLocation={folder}/state
SlurmdSpoolDir={runtime}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
MailProg=/bin/true
SlurmctldDebug=info
SlurmdDebug=info
PlugStackConfig={folder}/plugstack.conf
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
JobCompType=jobcomp/none
MpiDefault=none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerType=sched/builtin
SchedulerParameters=batch_sched_delay=0,sched_interval=1
SlurmdParameters=config_overrides
ReturnToService=2
KillWait=30
MinJobAge=600
JobRequeue=1
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
NodeName={host} NodeHostname={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=1048576 State=UNKNOWN
PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP PriorityTier=1 GraceTime=20
PartitionName=urgent Nodes={host} MaxTime=INFINITE State=UP PriorityTier=10
"""


def search_path() -> str:
    """The PATH of this process, and the folders where Debian puts daemons."""
    return os.pathsep.join([os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"])


def missing_programs() -> list[str]:
    """The programs of Debian's slurm-wlm and munge that are not installed."""
    return [program for program in (*DAEMONS, *COMMANDS) if shutil.which(program, path=search_path()) is None]


def unavailable() -> str:
    """Why no cluster can be started on this machine; empty if one can."""
    if missing := missing_programs():
        return f"{', '.join(missing)} not installed: apt-get install slurm-wlm munge"
    return "" if os.geteuid() == 0 else "only root can start Slurm's daemons"


@dataclass
class SlurmCluster:
    """A running cluster.

    ``environment`` is that of this process, without variables of another Slurm and with ``SLURM_CONF``: pass it to
    every process that submits or queries jobs.
    """

    folder: Path
    runtime: Path
    environment: dict[str, str]
    daemons: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    @property
    def configuration(self) -> Path:
        return Path(self.environment["SLURM_CONF"])

    def run(self, *command: str, timeout: float = 30.0) -> str:
        """Run a command and return its stripped output; raises RuntimeError if it fails. The timeout is in seconds."""
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True, timeout=timeout)
        if done.returncode != 0:
            raise RuntimeError(f"{' '.join(command)} failed with {done.returncode}: {done.stderr.strip()}")
        return done.stdout.strip()

    def restart_controller(self) -> None:
        """Kill slurmctld, once its state is on disk, and start it again while jobs keep running."""
        asked = time.time()
        last = max(map(self._written, ("job_state", "node_state")))
        while time.time() < last + SAVE_INTERVAL + 1.0 and self._written("job_state") <= asked:
            time.sleep(0.05)
        self.daemons["slurmctld"].kill()
        self.daemons["slurmctld"].wait()
        self._start_controller()
        self._await_node({"idle", "mixed", "allocated"})

    def processes(self) -> list[int]:
        """The ids of the running processes of the cluster: its daemons, its jobs and all their descendants."""
        parents: dict[int, int] = {}
        found: set[int] = set()
        marker = f"SLURM_CONF={self.configuration}".encode()
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit():
                continue
            with contextlib.suppress(OSError):
                variables = (entry / "environ").read_bytes().split(b"\0")
                name, _, rest = (entry / "stat").read_text().partition("(")[2].rpartition(")")
                parents[int(entry.name)] = int(rest.split()[1])
                of_job = any(variable.startswith(b"SLURM_JOB_ID=") for variable in variables)
                if marker in variables and (of_job or name in PROCESSES):
                    found.add(int(entry.name))
        while children := {process for process, parent in parents.items() if parent in found} - found:
            found |= children
        return sorted(found)

    def start(self) -> None:
        """Start the daemons; raises TimeoutError or RuntimeError if the node is not idle within 30 seconds."""
        munge_socket = self.runtime / "munge.socket"
        self._launch(
            "munged",
            "--foreground",
            "--force",
            f"--key-file={self.folder / 'munge.key'}",
            f"--socket={munge_socket}",
            f"--pid-file={self.folder / 'munged.pid'}",
            f"--seed-file={self.folder / 'munged.seed'}",
            "--origin=127.0.0.1",
        )
        self._until(munge_socket.exists, 10.0, lambda: "munged's socket")
        self._start_controller()
        self._launch("slurmd", "-D", "-f", str(self.configuration))
        self._await_node({"idle"})

    def stop(self) -> None:
        """Kill all daemons and processes of jobs; raises TimeoutError if some are left after 10 seconds."""
        deadline = time.monotonic() + 10.0
        while processes := self.processes():
            if time.monotonic() > deadline:
                raise TimeoutError(f"processes of {self.configuration} that cannot be killed: {processes}")
            for process in processes:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            time.sleep(0.05)
        for daemon in self.daemons.values():
            daemon.wait()
        shutil.rmtree(self.runtime, ignore_errors=True)

    def logs(self, lines: int = 20) -> str:
        """The last lines of the logs of all daemons."""
        tails = []
        for name in self.daemons:
            path = self.folder / f"{name}.log"
            path = path if path.exists() else path.with_suffix(".out")
            tails += [f"== {path}", *path.read_text(errors="replace").splitlines()[-lines:]]
        return "\n".join(tails)

    def _launch(self, name: str, *arguments: str) -> None:
        """Start a daemon in the foreground; its output goes to a file with its name."""
        program = shutil.which(name, path=self.environment["PATH"])
        assert program is not None
        with (self.folder / f"{name}.out").open("ab") as messages:
            self.daemons[name] = subprocess.Popen(
                [program, *arguments],
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=messages,
                stderr=messages,
                start_new_session=True,
            )

    def _start_controller(self) -> None:
        self._launch("slurmctld", "-D", "-f", str(self.configuration))
        self._until(
            lambda: " is UP" in self._ask("scontrol", "ping"), 30.0, lambda: "an answer of slurmctld to scontrol ping"
        )

    def _await_node(self, states: set[str]) -> None:
        """Wait until the node answers and is in one of the states."""
        command = ("sinfo", "--noheader", "--partition=main", "--format=%T")
        self._until(lambda: self._ask(*command) in states, 30.0, lambda: f"the node, which is {self._ask(*command)}")

    def _written(self, name: str) -> float:
        """When a file of slurmctld's state was written, in seconds since 1970; 0 if there is none."""
        try:
            return (self.folder / "state" / name).stat().st_mtime
        except FileNotFoundError:
            return 0.0

    def _ask(self, *command: str) -> str:
        """The output of a command; empty if it fails."""
        try:
            return self.run(*command, timeout=10.0)
        except (RuntimeError, subprocess.TimeoutExpired):
            return ""

    def _until(self, reached: Callable[[], bool], seconds: float, what: Callable[[], str]) -> None:
        """Poll ten times a second until ``reached``; raises TimeoutError, or RuntimeError if a daemon has ended."""
        deadline = time.monotonic() + seconds
        while not reached():
            for name, daemon in self.daemons.items():
                if daemon.poll() is not None:
                    raise RuntimeError(f"{name} ended with {daemon.returncode}")
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {seconds:g} seconds for {what()}")
            time.sleep(0.1)


def free_ports(count: int) -> list[int]:
    """Distinct ports on which nothing listens at the moment."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in sockets]


@contextlib.contextmanager
def slurm_cluster(folder: Path) -> Iterator[SlurmCluster]:
    """A cluster of one node with two CPUs (possibly more than exist), stopped with its jobs at the end.

    Its partitions are ``main`` and ``urgent``. A job in ``urgent`` that needs the CPUs of a job in ``main`` preempts
    it: the steps of the latter get SIGTERM, and unless it ends or requeues itself it is killed and requeued 20 to 30
    seconds later.

    Jobs of a partition start in the order of submission, without backfill: Slurm does not write the start of a
    backfilled job to disk. Raises RuntimeError with the ends of the logs if the cluster does not start.
    """
    if reason := unavailable():
        raise RuntimeError(reason)
    host = socket.gethostname().split(".")[0]
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "state").mkdir(exist_ok=True)
    # Paths of sockets must be short, and every directory above munged's must be readable by all users.
    runtime = Path(tempfile.mkdtemp(prefix="slurm-", dir="/tmp"))
    runtime.chmod(0o755)
    (runtime / "spool").mkdir()
    key = folder / "munge.key"
    key.touch(mode=0o600)
    key.write_bytes(secrets.token_bytes(128))
    controller_port, node_port = free_ports(2)
    configuration = folder / "slurm.conf"
    configuration.write_text(
        CONFIGURATION.format(
            host=host,
            controller_port=controller_port,
            node_port=node_port,
            folder=folder,
            runtime=runtime,
            credential_lifetime=CREDENTIAL_LIFETIME,
        )
    )
    (folder / "plugstack.conf").write_text("")
    # Control groups are not used, but slurmd exits if it cannot detect their version.
    (folder / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\n")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(PREFIXES)}
    cluster = SlurmCluster(folder, runtime, {**environment, "PATH": search_path(), "SLURM_CONF": str(configuration)})
    try:
        try:
            cluster.start()
        except (OSError, RuntimeError) as error:
            raise RuntimeError(f"Slurm did not start: {error}\n{cluster.logs()}") from error
        yield cluster
    finally:
        cluster.stop()
