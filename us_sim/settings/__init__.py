"""What can be set: once said, in its unit and range, beside what it sets."""
