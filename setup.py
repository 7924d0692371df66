"""Install rules of the ROS package (colcon builds it as ament_python)."""

from glob import glob

from setuptools import find_packages, setup

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
)

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
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
        (f"share/{NAME}/config", glob("config/*")),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    entry_points={
        "console_scripts": [f"{name} = {NAME}.entry:{name}" for name in EXECUTABLES],
    },
)
