import re
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

package = "push_ident"

# What runs without ROS, by import. `make test-oldest` runs the tests that need no ROS with the least versions of these and of `report`:
# requirements/oldest.txt. Those of numpy, scipy, OpenCV, rich, PyYAML, Jinja2 and Matplotlib are what Ubuntu 24.04 has.
requires = [
    "backports-zstd>=1.0; python_version < '3.14'",
    "mcap>=1.5",
    "numba>=0.68",  # an IntEnum as an index
    "numpy>=1.26.4",
    "opencv-python-headless>=4.6",
    "pydantic>=2.10",
    "pyyaml>=6.0.1",
    "rich>=13.7",
    "rosbags>=0.11.9",  # reads definitions of messages through its internals
    "scipy>=1.11.4",
    "threadpoolctl>=3.1",
    "typer>=0.19",  # choices as Literal
]
# Modules of each: push_ident/extras.py. Other least versions are those of the pins in requirements/, with which the tests run.
extras = {
    "arm": ["pin>=4.1"],
    "bullet": ["pybullet>=3.2"],
    "fleet": ["pyarrow>=26.0", "ray>=2.60"],
    "mit": ["h5py>=3.16"],
    "mujoco": ["mujoco>=3.3,<4"],
    "pcd": ["open3d>=0.20"],
    "report": ["jinja2>=3.1.2", "markupsafe>=2.1.5", "matplotlib>=3.6.3"],
    "torch": ["torch>=2.13"],
    "viewer": ["rerun-sdk>=0.41"],
}

(version,) = re.findall(r'^__version__ = "(.+)"$', Path(package, "__init__.py").read_text(encoding="utf-8"), re.MULTILINE)

# What ROS brings: package.xml (rosdep). All stands here: colcon cannot read a `python_requires` of setup.cfg.
setup(
    name=package,
    version=version,
    packages=find_packages(include=[package, f"{package}.*"]),
    package_data={"": ["py.typed", "*.html", "*.j2"], f"{package}.bags": ["msg/*.msg"], f"{package}.nodes.base": ["*.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
        (f"share/{package}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{package}/config", sorted(glob("config/*.*"))),
        (f"share/{package}/config/robots", sorted(glob("config/robots/*.yaml"))),
        (f"share/{package}/config/ros2_controllers", sorted(glob("config/ros2_controllers/*.yaml"))),
    ],
    install_requires=requires,
    extras_require={**extras, "all": sorted({name for names in extras.values() for name in names}), "test": ["pytest"]},
    python_requires=">=3.11",
    zip_safe=False,
    url="https://push-ident.example",
    project_urls={"Source": "https://push-ident.example/push_ident.git", "Issues": "https://push-ident.example/issues"},
    author="push_ident maintainers",
    author_email="maintainers@push-ident.example",
    maintainer="push_ident maintainers",
    maintainer_email="maintainers@push-ident.example",
    description="Identifies per-cell mass and support friction of unknown objects by pushing them, and predicts their motion.",
    long_description=Path("README.md").read_text(encoding="utf-8") if Path("README.md").is_file() else "",
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "push-ident = push_ident.cli.entry:main",
            "perception_node = push_ident.nodes.executables:main",
            "push_executor_node = push_ident.nodes.executables:main",
            "identification_node = push_ident.nodes.executables:main",
            "bag_player_node = push_ident.nodes.executables:main",
            "bag_recorder_node = push_ident.nodes.executables:main",
            "gap_diagnosis_node = push_ident.nodes.executables:main",
            "goal_pushing_node = push_ident.nodes.executables:main",
            "viewer_node = push_ident.nodes.executables:main",
        ],
    },
)
