"""What streams to the pages of the viewer: one file a stream, subscribed to only while watched."""
