"""What colcon runs to build and install sros in a ROS workspace; pip reads only pyproject.toml.

Everything that pyproject.toml says is taken from there.  It is read here because the setuptools of
Ubuntu 24.04 (68) refuses its current form, such as a licence without a table.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from pathlib import Path

import setuptools

HERE = Path(__file__).resolve().parent
PROJECT = tomllib.loads((HERE / "pyproject.toml").read_text())["project"]
NAME = PROJECT["name"]
LINKED = Path.cwd().resolve() != HERE
"""With --symlink-install, colcon runs a link to this file among links to all packages."""
BESIDE = () if LINKED else ("policies", "keystore_templates")
"""What lies next to the package and belongs into it; the linked package finds it there."""


class Distribution(setuptools.Distribution):
    """A distribution that is described by this file alone."""

    def parse_config_files(
        self, filenames: Iterable[str] | None = None, ignore_option_errors: bool = False
    ) -> None:
        """Read the configuration of setuptools, but not pyproject.toml."""
        super().parse_config_files(filenames or self.find_config_files(), ignore_option_errors)


setuptools.setup(
    distclass=Distribution,
    name=NAME,
    version=PROJECT["version"],
    description=PROJECT["description"],
    license=PROJECT["license"],
    python_requires=PROJECT["requires-python"],
    install_requires=PROJECT["dependencies"],
    packages=[
        *setuptools.find_packages(str(HERE), include=(NAME, f"{NAME}.*")),
        *(f"{NAME}.{folder}" for folder in BESIDE),
    ],
    package_dir={f"{NAME}.{folder}": folder for folder in BESIDE},
    package_data={"": ["**/*"]},
    exclude_package_data={"": ["**/*.pyc"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"colcon/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/environment", ["colcon/ros2_security.sh"]),
        (
            f"share/{NAME}/ros2_security/sros_ros2_security.dist-info",
            ["colcon/METADATA", "colcon/entry_points.txt"],
        ),
    ],
    entry_points={
        "console_scripts": [f"{name} = {target}" for name, target in PROJECT["scripts"].items()],
        **{
            group: [f"{name} = {target}" for name, target in targets.items()]
            for group, targets in PROJECT["entry-points"].items()
        },
    },
    zip_safe=False,
)
