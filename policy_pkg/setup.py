from setuptools import setup

package = "policy_pkg"

setup(
    name=package,
    version="0.1.0",
    description="Decentralised QMIX agents: policy nodes and the trainer.",
    maintainer="Crash Coach engineers",
    maintainer_email="team@crash-coach.dev",
    license="Apache-2.0",
    packages=[
        "policy_pkg",
        "policy_pkg.bags",
        "policy_pkg.export",
        "policy_pkg.learner",
        "policy_pkg.learner.native",
        "policy_pkg.native",
        "policy_pkg.play",
        "policy_pkg.report",
        "policy_pkg.ros",
        "policy_pkg.ros.trainer",
        "policy_pkg.sweep",
        "policy_pkg.train",
        "policy_pkg.train.live",
        "policy_pkg.train.loggers",
        "policy_pkg.train.offline",
    ],
    package_data={
        "policy_pkg": [
            "configs/**/*.yaml",
            "ros/*.xml",
            "native/*.cpp",
            "native/*.h",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml", "LICENSE"]),
    ],
    install_requires=["setuptools"],
    # What a policy node or a program of one's own acts with; rclpy comes with ROS.
    extras_require={"test": ["pytest"], "acting": ["numpy", "pydantic", "safetensors"]},
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "policy = policy_pkg.executables:policy",
            "recorder = policy_pkg.executables:recorder",
            "team = policy_pkg.executables:team",
            "trainer = policy_pkg.executables:trainer",
        ],
    },
)
