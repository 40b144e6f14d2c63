# Variants of one build of the engine. Sources that the definitions of a variant do not reach are compiled once for all.

# Processors with AVX2 have conversions to half precision.
set(halves_avx2 -mf16c)

function(compiled target)
  target_compile_options(${target} PRIVATE ${flags} ${${SPLATMILL_VARIANT_ISA}} ${halves_${SPLATMILL_VARIANT_ISA}}
    $<$<CXX_COMPILER_ID:GNU,Clang>:-fno-stack-protector>)
  target_include_directories(${target} PRIVATE ${kernels})
  target_link_libraries(${target} PRIVATE nanobind-static OpenMP::OpenMP_CXX)
  set_target_properties(${target} PROPERTIES POSITION_INDEPENDENT_CODE ON)
endfunction()

# variant(NAME "DEFINITIONS" SOURCES...): the module _cpu_ISA in the folder NAME; SOURCES are the stems that see the definitions.
function(variant name definitions)
  set(own ${kernels}/bindings/module.cpp)
  set(shared)
  foreach(source ${sources})
    get_filename_component(stem ${source} NAME_WE)
    if(stem STREQUAL module)
      continue()
    elseif(stem IN_LIST ARGN)
      list(APPEND own ${source})
    else()
      if(NOT TARGET plain_${stem})
        add_library(plain_${stem} OBJECT ${source})
        compiled(plain_${stem})
      endif()
      list(APPEND shared $<TARGET_OBJECTS:plain_${stem}>)
    endif()
  endforeach()
  # A domain of its own: all variants live in one process, and their frames differ.
  nanobind_add_module(variant_${name} NOMINSIZE NB_STATIC NB_DOMAIN splatmill_variant_${name} ${own} ${shared})
  compiled(variant_${name})
  target_compile_definitions(variant_${name} PRIVATE SPLATMILL_MODULE=_cpu_${SPLATMILL_VARIANT_ISA} ${definitions})
  set_target_properties(variant_${name} PROPERTIES
    OUTPUT_NAME _cpu_${SPLATMILL_VARIANT_ISA} LIBRARY_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/variants/${name})
endfunction()

include(${SPLATMILL_VARIANTS})
