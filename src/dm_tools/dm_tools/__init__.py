"""The dm command, bench console, recordings, security profile and generated documentation."""
