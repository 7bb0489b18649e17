"""The import surface of the RoboMME benchmark over the environments of mme-vla."""
