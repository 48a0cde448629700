"""ros_jobs."""
