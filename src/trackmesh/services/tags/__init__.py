"""Tags: where RFID and UWB tags are, from ranges that readers take now and then."""
