"""De-identification of scanners' files."""
