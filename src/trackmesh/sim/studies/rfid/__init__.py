"""RFID tags by EKF and UKF: the slides' comparison anew, and what mends it."""
