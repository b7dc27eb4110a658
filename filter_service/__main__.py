"""``python -m filter_service``: start the service."""

from filter_service.serve import main

if __name__ == "__main__":
    main()
