from glob import glob

from setuptools import find_packages, setup

package = "push_ident"

# What runs without ROS, by import. The least versions are those of the pins in requirements/, with which the tests run.
requires = [
    "backports-zstd>=1.8; python_version < '3.14'",
    "lz4>=4.4",
    "mcap>=1.6",
    "numba>=0.68",
    "numpy>=2.4",
    "opencv-python-headless>=5.0",
    "pydantic>=2.14",
    "pyyaml>=6.0",
    "rich>=15.0",
    "rosbags>=0.11",
    "scipy>=1.17",
    "typer>=0.29",
]
# Modules of each: push_ident/extras.py.
extras = {
    "arm": ["pin>=4.1"],
    "fleet": ["pyarrow>=26.0", "ray>=2.60"],
    "mit": ["h5py>=3.16"],
    "pcd": ["open3d>=0.20"],
    "report": ["jinja2>=3.1", "matplotlib>=3.11"],
    "torch": ["torch>=2.13"],
}

# Name, version and description: setup.cfg. What ROS brings: package.xml (rosdep).
setup(
    packages=find_packages(include=[package, f"{package}.*"]),
    package_data={"": ["py.typed", "*.html", "*.j2"], f"{package}.bags": ["msg/*.msg"], f"{package}.nodes": ["*.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
        (f"share/{package}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{package}/config", sorted(glob("config/*.*"))),
        (f"share/{package}/config/robots", sorted(glob("config/robots/*.yaml"))),
    ],
    install_requires=requires,
    extras_require={**extras, "all": sorted({name for names in extras.values() for name in names}), "test": ["pytest"]},
    zip_safe=False,
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
