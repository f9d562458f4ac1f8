from glob import glob

from setuptools import setup

package = "crash_coach_bringup"

setup(
    name=package,
    version="0.1.0",
    description="Launch files, layouts and the crash-coach command line.",
    maintainer="Crash Coach engineers",
    maintainer_email="team@crash-coach.dev",
    license="Apache-2.0",
    packages=[
        "crash_coach_bringup",
        "crash_coach_bringup.cli",
        "crash_coach_bringup.cli.faults",
        "crash_coach_bringup.cli.report",
        "crash_coach_bringup.cli.verbs",
        "crash_coach_bringup.ros",
    ],
    package_data={},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml", "LICENSE"]),
        (f"share/{package}/launch", glob("launch/*.launch.py")),
        (f"share/{package}/rviz", glob("rviz/*.rviz")),
        (f"share/{package}/config", glob("config/*")),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "crash-coach = crash_coach_bringup.cli.start:main",
        ],
    },
)
