from glob import glob

from setuptools import find_packages, setup

package = "push_ident"

setup(
    name=package,
    version="0.1.0",
    packages=find_packages(include=[package, f"{package}.*"]),
    package_data={"": ["py.typed", "*.html", "*.j2"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
        (f"share/{package}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{package}/config", sorted(glob("config/*.*"))),
        (f"share/{package}/config/robots", sorted(glob("config/robots/*.yaml"))),
    ],
    # What is needed to run stands in package.xml (rosdep) and in requirements/ (pip).
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    python_requires=">=3.11",
    zip_safe=False,
    maintainer="push_ident maintainers",
    maintainer_email="maintainers@push-ident.example",
    description="Identifies per-cell mass and support friction of unknown objects by pushing them, and predicts their motion.",
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
