"""OpenIGTLink: messages, client and server."""
