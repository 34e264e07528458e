"""The paper's section II as functions: depth error, calibration-error and synchronization laws."""
