"""Install rules of the ROS package (colcon builds it as ament_python)."""

import os
import subprocess
import sys
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py
from setuptools.command.develop import develop
from setuptools.command.install import install

NAME = "smp_motor_control"
EXECUTABLES = (
    "wheel_pid",
    "motor_plant",
    "skid_steer",
    "teleop_wheels",
    "excite",
    "record",
    "play",
    "identifier",
    "identify",
    "tune",
    "commission",
    "demo",
    "serial_driver",
)


def require_messages() -> None:
    """Refuse to install half of the repository: executables that would not find their messages."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    found = any(Path(p, "share/smp_interfaces/package.xml").is_file() for p in prefixes if p)
    if "COLCON" in os.environ and not found:
        here = Path(__file__).resolve().parent
        raise SystemExit(
            "smp_interfaces is not built yet, and colcon does not look for it below this package; "
            f"type: colcon build --base-paths {here} {here}/smp_interfaces"
        )


def compile_ahead(folder: str) -> None:
    """Compile for this machine what computes, or leave that to the first estimate."""
    if "COLCON" not in os.environ:
        return
    path = os.pathsep.join(p for p in (folder, os.environ.get("PYTHONPATH", "")) if p)
    done = subprocess.run(
        [sys.executable, "-m", "smp_motor_ident.compilation"],
        cwd=folder, env={**os.environ, "PYTHONPATH": path}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        print(f"{NAME}: the first estimate will compile for half a minute ({reason})")


class BuildPy(build_py):
    """As colcon build asks for."""

    def run(self) -> None:
        """Build what is whole."""
        require_messages()
        super().run()


class Develop(develop):
    """As colcon build --symlink-install asks for."""

    def run(self) -> None:
        """Link what is whole, and compile it."""
        require_messages()
        super().run()
        if not self.uninstall:
            compile_ahead(os.getcwd())


class Install(install):
    """As colcon build asks for, after it."""

    def run(self) -> None:
        """Copy, and compile what was copied."""
        super().run()
        compile_ahead(str(Path(self.install_lib or ".").resolve()))


setup(
    name=NAME,
    version="0.1.0",
    description="Identifies the DC motors of a robot from bags and controls its wheels.",
    license="Apache-2.0",
    maintainer="smp_motor_control maintainers",
    maintainer_email="maintainers@smp-motor-control.invalid",
    python_requires=">=3.10,<3.14",
    packages=find_packages(include=[f"{NAME}*", "smp_motor_ident*"]),
    package_data={"": ["py.typed", "*.jinja", "*.css", "*.js", "LICENSE"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (
            f"share/{NAME}",
            ["package.xml", "LICENSE", *glob("*.md"), "CHANGELOG.rst"],
        ),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
        (f"share/{NAME}/config", glob("config/*")),
        *(
            (f"share/{NAME}/{d}", glob(f"{d}/*.md"))
            for d in ("docs", "docs/howto", "docs/decisions")
        ),
        (f"share/{NAME}/docs/figures", glob("docs/figures/*.svg")),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest", "hypothesis"]},  # by which colcon test runs pytest
    cmdclass={"build_py": BuildPy, "develop": Develop, "install": Install},
    zip_safe=False,
    entry_points={
        "console_scripts": [f"{name} = {NAME}.entry:{name}" for name in EXECUTABLES],
    },
)
