"""The scripts behind the Makefile say clearly what is wrong, and repair the wheels once."""

import ast
import functools
import http.server
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from packaging.requirements import Requirement


def run(*command: str | Path, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """A command with its output; PATH and the given variables are all of its environment."""
    return subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env={"PATH": os.environ["PATH"], "PYTHONPATH": "", **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.fixture
def scripts(tmp_path: Path, root: Path) -> Path:
    """A copy of the scripts in a folder where nothing has been built."""
    shutil.copy(root / "setup.cfg", tmp_path)
    return Path(shutil.copytree(root / "scripts", tmp_path / "scripts"))


def test_environment_without_a_build_says_to_run_make(scripts: Path):
    result = run("bash", "-c", ". scripts/env.sh; echo status $?", cwd=scripts.parent)
    assert "status 1" in result.stdout
    assert "run 'make'" in result.stderr


def test_environment_has_one_fixed_order_of_libraries(scripts: Path):
    site = scripts.parent / ".venv/lib/python3.99/site-packages"
    for folder in ("ros_b.libs", "ros_a.libs"):
        (site / folder).mkdir(parents=True)
    python = scripts.parent / ".venv/bin/python"
    python.parent.mkdir()
    python.touch(mode=0o755)
    command = '. scripts/env.sh; . scripts/env.sh; echo "$LD_LIBRARY_PATH"; echo "$PATH"'
    libraries, path = run("bash", "-c", command, cwd=scripts.parent).stdout.splitlines()
    below = [os.path.relpath(entry, scripts.parent) for entry in libraries.split(":")]
    venv = ".venv/lib/python3.99/site-packages"
    assert below == ["install/lib", ".venv/lib", f"{venv}/ros_a.libs", f"{venv}/ros_b.libs"]
    assert path.split(":").count(str(python.parent)) == 1


@pytest.mark.parametrize("shell", ["bash", "dash", "sh"])
def test_environment_is_that_of_its_folder_in_any_shell(scripts: Path, shell: str):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    python = scripts.parent / ".venv/bin/python"
    python.parent.mkdir(parents=True)
    python.touch(mode=0o755)
    here = run(shell, "-c", '. ./scripts/env.sh; echo "$VIRTUAL_ENV"', cwd=scripts.parent)
    assert here.stdout.strip() == str(scripts.parent / ".venv"), here.stderr
    elsewhere = run(shell, "-c", f'. {scripts}/env.sh || exit 3; echo "$VIRTUAL_ENV"', cwd=scripts)
    if shell == "bash":
        assert elsewhere.stdout.strip() == str(scripts.parent / ".venv")
    else:
        assert elsewhere.returncode == 3 and "change to the folder" in elsewhere.stderr


def test_setup_without_a_usable_python_names_what_it_needs(scripts: Path):
    result = run("bash", "scripts/setup.sh", cwd=scripts.parent, PYTHON="/bin/false")
    assert result.returncode != 0
    assert "/bin/false" in result.stderr
    assert "3.10 to 3.13" in result.stderr


def test_documentation_without_its_packages_says_what_to_type(scripts: Path):
    python = scripts.parent / ".venv/bin/python"
    python.parent.mkdir(parents=True)
    python.write_text("#!/bin/sh\necho \"ModuleNotFoundError: No module named 'material'\" >&2; exit 1\n")
    python.chmod(0o755)
    result = run("bash", "scripts/docs.sh", cwd=scripts.parent)
    assert result.returncode == 1 and result.stdout == ""
    assert "No module named 'material'" in result.stderr and "scripts/setup.sh docs" in result.stderr


def test_failing_step_shows_the_end_of_its_output_and_where_the_rest_is(scripts: Path):
    command = ". scripts/common.sh; step check 'a check' bash -c 'echo the reason; exit 3'"
    result = run("bash", "-c", command, cwd=scripts.parent)
    assert result.returncode != 0
    assert "the reason" in result.stderr
    assert str(scripts.parent / "log/make/check.log") in result.stderr


def test_fingerprint_changes_with_content_names_and_deletions(scripts: Path):
    def fingerprint() -> str:
        return run("bash", "-c", ". scripts/common.sh; fingerprint tree", cwd=scripts.parent).stdout

    tree = scripts.parent / "tree"
    (tree / "__pycache__").mkdir(parents=True)
    (tree / "a.py").write_text("1")
    seen = [fingerprint()]
    (tree / "__pycache__" / "a.pyc").write_text("compiled")
    assert fingerprint() == seen[0]
    for change in (
        lambda: (tree / "a.py").write_text("2"),
        lambda: (tree / "a.py").rename(tree / "b.py"),
        lambda: (tree / "c.py").write_text(""),
        lambda: (tree / "c.py").unlink(),
    ):
        change()
        seen.append(fingerprint())
    assert seen[-1] == seen[2]
    assert len(set(seen)) == len(seen) - 1


def test_unknown_extra_is_refused_with_the_valid_ones(scripts: Path):
    result = run(sys.executable, "scripts/requirements.py", "tests", cwd=scripts.parent)
    assert result.returncode != 0
    assert "'tests'" in result.stderr
    assert "there are: train, " in result.stderr


def locked(path: Path) -> dict[str, list[str]]:
    """The versions of each package in a file of exact versions; several where they differ between Pythons."""
    versions: dict[str, list[str]] = {}
    for line in path.read_text().splitlines():
        if line and not line.startswith("#"):
            requirement = Requirement(line)
            versions.setdefault(requirement.name, []).append(str(requirement.specifier).removeprefix("=="))
    return versions


def required(root: Path, *extras: str) -> list[Requirement]:
    """What setup.cfg requires with these extras, PyTorch aside."""
    lines = run(sys.executable, "scripts/requirements.py", *extras, cwd=root).stdout.splitlines()
    assert len(lines) > 10
    return [requirement for requirement in map(Requirement, lines) if requirement.name != "torch"]


def test_the_locked_versions_lie_in_the_ranges_of_the_package(root: Path):
    versions = locked(root / "scripts" / "constraints.txt")
    for requirement in required(root, "train", "cluster", "test", "lint", "docs", "lock"):
        allowed = versions[requirement.name.lower()]
        assert all(requirement.specifier.contains(version) for version in allowed), (
            f"{requirement}: `make lock`"
        )


def test_the_lowest_versions_are_those_that_the_package_allows(root: Path):
    """Patch releases aside: the first one of a version may have been withdrawn or may lack wheels."""
    versions = locked(root / "scripts" / "lowest.txt")
    for requirement in required(root, "train", "test"):
        (lowest,) = versions[requirement.name.lower()]
        (bound,) = [item.version for item in requirement.specifier if item.operator == ">="]
        assert f"{lowest}.".startswith(f"{bound}."), f"{requirement}, tested with {lowest}: `make lock`"


def test_torch_of_the_command_line_stands_in_for_that_of_the_package(scripts: Path):
    command = (sys.executable, "scripts/requirements.py", "train")
    lines = run(*command, cwd=scripts.parent, TORCH="torch==2.13.0+cpu").stdout.splitlines()
    assert [line for line in lines if line.startswith("torch")] == ["torch==2.13.0+cpu"]


def test_the_command_of_an_environment_runs_its_python_activated_or_not(scripts: Path, tmp_path: Path):
    command = Path(shutil.copy(scripts / "tactile", tmp_path / "tactile"))
    (tmp_path / "python3").write_text('#!/bin/sh\necho "the one beside it: $*"\n')
    (tmp_path / "python3").chmod(0o755)
    link = tmp_path / "elsewhere"
    link.symlink_to(command)
    for called in (command, link):
        said = run(called, "simulate", "--help", cwd=Path("/"))
        assert said.stdout == f"the one beside it: {called} simulate --help\n", said.stderr


@pytest.fixture
def without_gpu(scripts: Path, tmp_path: Path):
    """`cpu_torch.py` on a machine without GPU, with an index of its own; says what it would install."""
    index = tmp_path / "index" / "torch"
    index.mkdir(parents=True)
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=index.parent)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    script = scripts / "cpu_torch.py"
    text = script.read_text().replace('Path("/dev")', f'Path("{tmp_path}")').replace('"nvidia-smi"', '"none"')
    script.write_text(
        text.replace("https://download.pytorch.org/whl/cpu", f"http://127.0.0.1:{server.server_port}")
    )
    (scripts / "install.py").write_text("import sys; print(sys.argv[1:])")

    def choose(*listed: str, **environment: str) -> str:
        (index / "index.html").write_text("".join(f'<a href="/{name}">' for name in listed))
        command = (
            sys.executable,
            "-S",
            script,
            "torch==2.13.0",
        )  # without the site's packages, PyTorch among them
        result = run(*command, cwd=tmp_path, **environment)
        assert result.returncode == 0, result.stderr
        return result.stdout + result.stderr

    yield choose
    server.shutdown()


def test_without_a_gpu_pytorch_is_installed_without_cuda_where_its_index_has_it(without_gpu, tmp_path: Path):
    wheel = f"torch-2.13.0%2Bcpu-cp3{sys.version_info.minor}-cp3{sys.version_info.minor}-linux.whl"
    said = without_gpu(wheel)
    assert "'--no-deps', '--index-url', 'http://127.0.0.1" in said and "'torch==2.13.0+cpu'" in said
    assert "perhaps with gigabytes of CUDA: http://127" in without_gpu("torch-2.13.0%2Bcpu-cp27-cp27.whl")
    assert without_gpu(wheel, TORCH="torch==2.9.1") == ""
    (tmp_path / "nvidia0").touch()
    assert without_gpu(wheel) == ""


def test_an_index_that_does_not_answer_is_told_and_fails_nothing(without_gpu, scripts: Path):
    script = scripts / "cpu_torch.py"
    script.write_text(re.sub(r"127\.0\.0\.1:\d+", "127.0.0.1:9", script.read_text()))
    said = without_gpu()
    assert "PyTorch is taken as found" in said and "does not answer" in said


def test_repair_rewrites_stale_paths_once(scripts: Path):
    spec = importlib.util.spec_from_file_location("repair_ros_wheels", scripts / "repair_ros_wheels.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    cmake = scripts.parent / "share/std_msgs/cmake/export.cmake"
    cmake.parent.mkdir(parents=True)
    stale = "/opt/python/cp311-cp311"
    cmake.write_text(
        f'"{stale}/include/python3.11;{stale}/lib/python3.11/site-packages/numpy/_core/include" "{stale}/lib"'
    )
    assert module.repair(scripts.parent) == 1
    repaired = cmake.read_text()
    assert "/opt/python" not in repaired
    assert all(Path(path).is_dir() for path in repaired.split('"')[1].split(";"))
    assert module.repair(scripts.parent) == 0


@pytest.mark.parametrize("there", [False, True])
def test_an_install_without_the_messages_fails_with_what_to_type(tmp_path: Path, root: Path, there: bool):
    """As plain `colcon build` would make one, since it does not look for packages inside of a package."""
    shutil.copy(root / "setup.py", tmp_path)
    share = tmp_path / "prefix/share/tactile_msgs"
    if there:
        share.mkdir(parents=True)
        (share / "package.xml").touch()
    for folder in ("resource", "scripts", "launch", "config"):
        (tmp_path / folder).mkdir()
    command = [sys.executable, "setup.py", "--help", "install"]
    done = run(*command, cwd=tmp_path, AMENT_PREFIX_PATH=str(tmp_path / "prefix"))
    assert (done.returncode == 0) == there
    assert there or f"colcon build --base-paths src {tmp_path}/tactile_msgs" in done.stderr


def test_c_code_that_does_not_compile_fails_the_build_with_its_name(tmp_path: Path, root: Path):
    for name in ("setup.py", "setup.cfg", "package.xml", "LICENSE"):
        shutil.copy(root / name, tmp_path)
    for folder in ("resource", "scripts"):
        shutil.copytree(root / folder, tmp_path / folder)
    for folder in ("tactile_geometry/_csrc", "tactile_filter/_csrc", "tactile_sim/_csrc"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "broken.c").write_text("int broken(void) { return 1 }\n")
    result = run(sys.executable, "setup.py", "build_ext", "--inplace", cwd=tmp_path)
    assert result.returncode != 0
    assert "broken.c:1" in result.stdout + result.stderr


def test_packages_are_looked_for_where_pip_is_told_to_look(scripts: Path, tmp_path: Path):
    text = "[global]\nindex-url = https://lab.example/simple\nfind-links = /of/the/file\n"
    (tmp_path / "pip.conf").write_text(text)
    result = run(
        sys.executable, "-c", "import install; print(install.configured())", cwd=scripts,
        PIP_CONFIG_FILE=str(tmp_path / "pip.conf"), PIP_FIND_LINKS="/wheels",
        PIP_EXTRA_INDEX_URL="https://one.example https://two.example",
    )  # fmt: skip
    wanted = {
        "UV_INDEX_STRATEGY": "unsafe-best-match",
        "UV_DEFAULT_INDEX": "https://lab.example/simple",
        "UV_INDEX": "https://one.example https://two.example",
        "UV_FIND_LINKS": "/wheels",
    }
    assert wanted.items() <= ast.literal_eval(result.stdout).items(), result.stderr


def test_without_uv_or_where_it_fails_pip_installs(scripts: Path, tmp_path: Path):
    """With a Python that is a script: it notes what it is asked for, and has no uv to give."""
    python, asked = tmp_path / "bin" / "python", tmp_path / "asked"
    python.parent.mkdir()
    python.write_text(f'#!/bin/sh\necho "$@" >>{asked}\n')
    python.chmod(0o755)
    code = (
        "import pathlib, sys, install; "
        f"install.PIP = ({str(python)!r}, '-m', 'pip'); install.UV = pathlib.Path({str(tmp_path / 'uv')!r}); "
        "sys.argv = ['install.py', '-r', 'wanted.txt']; sys.exit(install.main())"
    )
    assert run(sys.executable, "-c", code, cwd=scripts).returncode == 0
    assert asked.read_text().splitlines()[-1] == "-m pip install --progress-bar off -r wanted.txt"
    (tmp_path / "uv").write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / "uv").chmod(0o755)
    result = run(sys.executable, "-c", code, cwd=scripts)
    assert result.returncode == 0 and "uv failed: trying pip" in result.stdout
    assert asked.read_text().splitlines()[-1] == "-m pip install --progress-bar off -r wanted.txt"


GIVES_WAY = """
import os, sys, time
yields = os.sched_getscheduler(0) == os.SCHED_IDLE
print(yields, flush=True)
end = time.monotonic() + 30.0 * (os.geteuid() == 0)  # nobody else may ask for a normal policy again
while os.sched_getscheduler(0) == os.SCHED_IDLE and time.monotonic() < end:
    time.sleep(0.01)
print(os.sched_getscheduler(0) == os.SCHED_IDLE and os.geteuid() == 0)
sys.exit(3)
"""


def test_what_gives_way_is_finished_like_anything_else_and_its_status_counts(root: Path, tmp_path: Path):
    (tmp_path / "work.py").write_text(GIVES_WAY)
    script = f"""
    . {root}/scripts/run_idle.sh
    run_idle {sys.executable} {tmp_path}/work.py >{tmp_path}/out &
    work=$!
    while ! grep -q . {tmp_path}/out; do sleep 0.01; done
    finish $work
    """
    assert subprocess.run(["bash", "-c", script], timeout=300).returncode == 3
    assert (tmp_path / "out").read_text().split() == ["True", "False"]


PYTEST = """#!/usr/bin/env bash
case "$*" in
    *last-failed*) echo "again" >>calls; exit $AGAIN ;;
    *"$PASSES"*) exit 0 ;;
esac
for word; do case $word in cache_dir=*) cache=${word#*=}/v/cache ;; esac; done
mkdir -p "$cache"; printf '{\\n%s}' "$FAILED" >"$cache/lastfailed"; exit 1
"""


@pytest.mark.parametrize("passes", ["not live", "-m live"])
@pytest.mark.parametrize(
    "retest, failed, again, status, asked",
    [("1", 1, 0, 0, True), ("1", 16, 1, 1, True), ("1", 17, 0, 1, False), ("0", 1, 0, 1, False)],
)
def test_few_tests_that_fail_beside_others_run_once_more_where_asked_for(
    scripts: Path, tmp_path: Path, retest: str, failed: int, again: int, status: int, asked: bool, passes: str
):
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    for name, text in {"pytest": PYTEST, "python": "#!/bin/sh\n"}.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    names = "".join(f'  "test_{number}": true\n' for number in range(failed))
    given = {"RETEST": retest, "FAILED": names, "AGAIN": str(again), "PASSES": passes}
    ended = run("scripts/test.sh", cwd=tmp_path, **given)
    assert ended.returncode == status, ended.stdout + ended.stderr
    assert (tmp_path / "calls").exists() is asked
    assert ("run once more, alone" in ended.stdout) is asked
