from setuptools import setup

package = "crash_coach_pkg"

setup(
    name=package,
    version="0.1.0",
    description="The coach decides who crashes, when and how; the gate carries it out.",
    maintainer="Crash Coach engineers",
    maintainer_email="team@crash-coach.dev",
    license="Apache-2.0",
    packages=[
        "crash_coach_pkg",
        "crash_coach_pkg.coach",
        "crash_coach_pkg.coach.strategies",
        "crash_coach_pkg.faults",
        "crash_coach_pkg.gate",
        "crash_coach_pkg.ros",
        "crash_coach_pkg.wrappers",
    ],
    package_data={"crash_coach_pkg": ["configs/**/*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml", "LICENSE"]),
    ],
    install_requires=["setuptools"],
    extras_require={
        "test": ["pytest"],
        "wrappers": ["numpy", "pydantic", "pettingzoo", "gymnasium"],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "coach = crash_coach_pkg.executables:coach",
            "gate = crash_coach_pkg.executables:gate",
        ],
    },
)
