from gapcert.lazy import LazyPackage as LazyPackage
