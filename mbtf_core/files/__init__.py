"""Files and folders: written safely, digested, owned, locked."""
