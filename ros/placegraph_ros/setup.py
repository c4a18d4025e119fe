"""The package of ROS 2, for colcon; placegraph itself is installed by pip."""

from setuptools import setup

NAME = "placegraph_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
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
