from setuptools import setup

package = "sim_pkg"

setup(
    name=package,
    version="0.1.0",
    description="Multi-robot simulator on pymunk: library, PettingZoo environment, ROS 2 node.",
    maintainer="Crash Coach engineers",
    maintainer_email="team@crash-coach.dev",
    license="Apache-2.0",
    packages=[
        "sim_pkg",
        "sim_pkg.render",
        "sim_pkg.ros",
        "sim_pkg.scenarios",
        "sim_pkg.scenarios.skirmish",
        "sim_pkg.scripted",
    ],
    package_data={"sim_pkg": ["configs/**/*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml", "LICENSE"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "sim = sim_pkg.executables:sim",
        ],
    },
)
