"""Cases: folders with a volume, its labels, surfaces and tissue, ready to scan."""
