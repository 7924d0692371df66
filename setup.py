# SPDX-License-Identifier: Apache-2.0
"""Install rules: an ament_python package for colcon, and a Python package for pip."""

import os
import shutil
import subprocess
import sys
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.develop import develop
from setuptools.command.install import install

NAME = "smp_motor_control"
ROOT = Path(__file__).resolve().parent
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
    "lab",
    "serial_driver",
)

# The only list of run-time requirements: pip reads it, and `make lock` pins it for `make setup`.
REQUIRES = [
    "numpy>=1.26,<3",
    "scipy>=1.11",
    "numba>=0.58,<0.62",  # compiles recursions that switch with friction
    "threadpoolctl>=3",  # keeps linear algebra of small matrices on one thread
    "rosbags>=0.11,<0.12",  # reads and writes bags of every storage without ROS
    "lz4>=4",  # unpacks chunks and files of bags
    "backports.zstd>=1; python_version < '3.14'",  # unpacks chunks, messages and files of bags
    "msgspec>=0.19,<1",  # reads identification.json into the types of result.py
    "jinja2>=3.1",  # templates of the pages
    "rich>=13",  # progress and tables in the terminal
    "pyyaml>=6",  # parameter files
]
EXTRAS = {
    "ros": [  # requirements of the nodes, as wheels, without a sourced ROS 2 Jazzy
        "ros-jazzy-rclpy[fastrtps]",
        "ros-jazzy-common-interfaces",
        "mcap>=1.2,<2",  # writes bags that are closed at every flush
    ],
    "fleet": [
        "distributed>=2024",
        "pyarrow>=14",
    ],  # identify --fleet on a cluster, tables as Parquet
    "lab": ["aiohttp>=3.9,<4"],  # the page of lab: HTTP and WebSockets in one library
    "xlsx": ["openpyxl>=3.1"],  # Excel workbooks
    "matlab": ["h5py>=3.10"],  # MATLAB files of version 7.3
    "test": [
        "pytest>=7",
        "hypothesis>=6",
        "mcap>=1.2,<2",
        "control>=0.10.2,<0.11",  # margins of the tuning are compared with its own
    ],
}


def find_files(pattern: str) -> list[str]:
    """Return the files of a pattern, without the links that colcon leaves of moved files."""
    return [name for name in glob(pattern, recursive=True) if os.path.isfile(name)]


def build_messages(build_base: Path) -> None:
    """Build `smp_interfaces` into this package's prefix, unless another prefix has it.

    colcon looks for no package below a folder that holds a package.xml.
    """
    prefix = Path(sys.prefix)  # colcon's, while it runs this file
    sourced = os.environ.get("AMENT_PREFIX_PATH", "")
    others = {Path(place) for place in sourced.split(os.pathsep) if place} - {prefix}
    if any((other / "share/smp_interfaces/package.xml").is_file() for other in others):
        return
    if shutil.which("cmake") is None:
        raise SystemExit("smp_interfaces needs cmake: apt install cmake")
    python_path = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    own = ("prefix_override", "colcon_distutils_commands")  # colcon's, for setuptools alone
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(p for p in python_path if Path(p).name not in own),
        "CMAKE_PREFIX_PATH": os.pathsep.join(
            filter(None, [os.environ.get("CMAKE_PREFIX_PATH"), sourced])
        ),
    }
    folder = build_base / "smp_interfaces"
    options = (
        f"-DCMAKE_INSTALL_PREFIX={prefix}",
        "-DBUILD_TESTING=OFF",
        f"-DPython3_EXECUTABLE={sys.executable}",
    )
    for command in (
        ["cmake", "-S", str(ROOT / "smp_interfaces"), "-B", str(folder), *options],
        ["cmake", "--build", str(folder), "--parallel", str(os.cpu_count() or 1)],
        ["cmake", "--install", str(folder)],
    ):
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        if done.returncode:
            print(done.stdout, done.stderr, sep="\n")
            raise SystemExit(
                f"smp_interfaces cannot be built ({' '.join(command[:2])} failed, see above): "
                "source ROS 2 Jazzy, or install it (rosdep install --from-paths src)"
            )


def compile_ahead(folder: str) -> None:
    """Compile for this machine what computes, or leave that to the first estimate."""
    path = os.pathsep.join(p for p in (folder, os.environ.get("PYTHONPATH", "")) if p)
    done = subprocess.run(
        [sys.executable, "-m", "smp_motor_ident.compilation"],
        cwd=folder, env={**os.environ, "PYTHONPATH": path}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        print(f"{NAME}: the first estimate will compile for half a minute ({reason})")


class Develop(develop):
    """As `colcon build --symlink-install` asks for."""

    def run(self) -> None:
        """Link into the source; under colcon, add the messages and compile."""
        super().run()
        if "COLCON" in os.environ and not self.uninstall:
            build_messages(Path.cwd())  # colcon runs this in its build folder
            compile_ahead(os.getcwd())


class Install(install):
    """As `colcon build` asks for."""

    def run(self) -> None:
        """Copy; under colcon, add the messages and compile."""
        super().run()
        if "COLCON" in os.environ:
            build_messages(Path(self.get_finalized_command("build").build_base).resolve().parent)
            compile_ahead(str(Path(self.install_lib or ".").resolve()))


setup(
    name=NAME,
    version="0.1.0",
    description="Identifies the DC motors of a robot from recordings and controls its wheels.",
    long_description=(ROOT / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    maintainer="smp_motor_control maintainers",
    maintainer_email="maintainers@smp-motor-control.invalid",
    python_requires=">=3.10,<3.14",
    packages=find_packages(include=[f"{NAME}*", "smp_motor_ident*"]),
    package_data={
        "": ["py.typed"],
        "smp_motor_ident": ["limits.md"],
        "smp_motor_ident.report": ["*.jinja", "*.css", "*.js", "uplot/*"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (
            f"share/{NAME}",
            ["package.xml", "LICENSE", *find_files("*.md"), "CHANGELOG.rst"],
        ),
        (f"share/{NAME}/launch", find_files("launch/*.launch.py")),
        (f"share/{NAME}/config", find_files("config/*")),
        *(
            (f"share/{NAME}/{folder}", find_files(f"{folder}/*.md"))
            for folder in sorted({str(Path(page).parent) for page in find_files("docs/**/*.md")})
        ),
        (f"share/{NAME}/docs/figures", find_files("docs/figures/*")),
    ],
    install_requires=REQUIRES,
    extras_require=EXTRAS,
    cmdclass={"develop": Develop, "install": Install},
    zip_safe=False,
    entry_points={
        "console_scripts": [f"{name} = {NAME}.entry:{name}" for name in EXECUTABLES],
    },
)
