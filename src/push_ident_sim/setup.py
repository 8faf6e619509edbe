from glob import glob

from setuptools import find_packages, setup

package = "push_ident_sim"

setup(
    name=package,
    version="0.1.0",
    packages=find_packages(include=[package, f"{package}.*"]),
    package_data={package: ["py.typed", "cell/urdf/**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
        (f"share/{package}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{package}/config", sorted(glob("config/*"))),
    ],
    # What is needed to run stands in package.xml (rosdep) and in requirements/ (pip).
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"], "newton": ["newton"], "pusht": ["gym-pusht"]},
    python_requires=">=3.11",
    zip_safe=False,
    url="https://push-ident.example",
    project_urls={"Source": "https://push-ident.example/push_ident.git", "Issues": "https://push-ident.example/issues"},
    author="push_ident maintainers",
    author_email="maintainers@push-ident.example",
    maintainer="push_ident maintainers",
    maintainer_email="maintainers@push-ident.example",
    description="Simulated push cell (arm, hand, table, objects, depth camera) behind the ROS interface of the real one.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "sim_cell_node = push_ident_sim.executables:main",
            "sim_hand_node = push_ident_sim.executables:main",
        ]
    },
)
