"""An overview of a recording: what each topic has, and which topics are inputs."""
