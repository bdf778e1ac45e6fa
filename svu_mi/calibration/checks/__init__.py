"""Do cameras, object, light and photographs fit each other? And if not, what would make them?"""
