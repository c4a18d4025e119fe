"""Package of ROS 2 for colcon; pip installs the code as `placegraph-ros`."""

from setuptools import setup

NAME = "placegraph_ros"

setup(
    name=NAME,
    version="0.2.0",
    packages=[],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/localizer.launch.py"]),
        (f"share/{NAME}/config", ["config/localizer.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={"console_scripts": ["localizer = placegraph_ros.node:main"]},
)
