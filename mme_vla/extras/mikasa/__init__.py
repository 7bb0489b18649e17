"""MIKASA-Robo-VLA 1.0.0, a second benchmark of memory: `env=mikasa`."""
