"""What crosses the network: messages, their bytes, their keys, the bus and the client. Imports nothing of ours."""
