# Lets CMake take the interface packages that come as wheels, and leaves out what no Python node loads.
#
# The wheels were compiled under /opt/python/cpXY-cpXY, and every exported <package>__rosidl_generator_py target
# still names that folder in INTERFACE_INCLUDE_DIRECTORIES. CMake refuses include folders that do not exist, so they
# are taken out once all targets are known; rosidl_generator_py adds the headers of the interpreter in use by itself.
#
# Every node here is Python: what only C++ nodes load is left out. A build on an installed ROS, which does not use this
# file, has it.
#
# Use: cmake -DCMAKE_PROJECT_INCLUDE=<this file>
function(push_ident_drop_foreign_python_headers)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(include_dirs ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(include_dirs)
      list(FILTER include_dirs EXCLUDE REGEX "^/opt/python/cp[0-9]+-cp[0-9]+/")
      set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${include_dirs}")
    endif()
  endforeach()
endfunction()

if(PROJECT_IS_TOP_LEVEL)
  cmake_language(DEFER CALL push_ident_drop_foreign_python_headers)
  find_package(rosidl_default_generators REQUIRED)
  list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE
    REGEX "^rosidl_(generator_cpp|typesupport_(cpp|fastrtps_cpp|introspection_cpp)):")
endif()
