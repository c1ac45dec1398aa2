// Compiles kernels on the first Vulkan device: reads the `list` that null-device.c writes from standard input, in the
// folder of its files, and prints for each a line of JSON with what the driver reports of it. For drivers of other
// processors, on which nightsplat itself is not run.

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <vulkan/vulkan.h>

#define MAX_CONSTANTS 32

static void check(VkResult result, const char *call) {
    if (result == VK_SUCCESS) return;
    fprintf(stderr, "compile: %s: %d\n", call, result);
    exit(1);
}
#define CALL(function, ...) check(function(__VA_ARGS__), #function)

static const char *const EXTENSIONS[] = {
    "VK_KHR_pipeline_executable_properties",
    "VK_KHR_shader_subgroup_uniform_control_flow",
};

static VkDevice open_device(void) {
    VkApplicationInfo application = {.sType = VK_STRUCTURE_TYPE_APPLICATION_INFO, .apiVersion = VK_API_VERSION_1_3};
    VkInstanceCreateInfo instance_info = {
        .sType = VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO,
        .pApplicationInfo = &application,
    };
    VkInstance instance;
    CALL(vkCreateInstance, &instance_info, NULL, &instance);
    uint32_t count = 1;
    VkPhysicalDevice physical;
    vkEnumeratePhysicalDevices(instance, &count, &physical);
    if (!count) check(VK_ERROR_INCOMPATIBLE_DRIVER, "vkEnumeratePhysicalDevices");
    VkPhysicalDeviceDriverProperties driver = {.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_DRIVER_PROPERTIES};
    VkPhysicalDeviceProperties2 properties = {
        .sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_PROPERTIES_2,
        .pNext = &driver,
    };
    vkGetPhysicalDeviceProperties2(physical, &properties);
    printf("{\"device\": \"%s\", \"driver\": \"%s %s\"}\n", properties.properties.deviceName, driver.driverName,
           driver.driverInfo);

    VkPhysicalDevicePipelineExecutablePropertiesFeaturesKHR executables = {
        .sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_PIPELINE_EXECUTABLE_PROPERTIES_FEATURES_KHR,
        .pipelineExecutableInfo = VK_TRUE,
    };
    VkPhysicalDeviceShaderSubgroupUniformControlFlowFeaturesKHR uniform = {
        .sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_SHADER_SUBGROUP_UNIFORM_CONTROL_FLOW_FEATURES_KHR,
        .pNext = &executables,
        .shaderSubgroupUniformControlFlow = VK_TRUE,
    };
    VkPhysicalDeviceVulkan13Features vulkan13 = {
        .sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_VULKAN_1_3_FEATURES,
        .pNext = &uniform,
        .subgroupSizeControl = VK_TRUE,
        .computeFullSubgroups = VK_TRUE,
    };
    VkPhysicalDeviceVulkan12Features vulkan12 = {
        .sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_VULKAN_1_2_FEATURES,
        .pNext = &vulkan13,
        .scalarBlockLayout = VK_TRUE,
    };
    float priority = 1;
    VkDeviceQueueCreateInfo queue = {
        .sType = VK_STRUCTURE_TYPE_DEVICE_QUEUE_CREATE_INFO,
        .queueCount = 1,
        .pQueuePriorities = &priority,
    };
    VkDeviceCreateInfo info = {
        .sType = VK_STRUCTURE_TYPE_DEVICE_CREATE_INFO,
        .pNext = &vulkan12,
        .queueCreateInfoCount = 1,
        .pQueueCreateInfos = &queue,
        .enabledExtensionCount = sizeof EXTENSIONS / sizeof *EXTENSIONS,
        .ppEnabledExtensionNames = EXTENSIONS,
    };
    VkDevice device;
    CALL(vkCreateDevice, physical, &info, NULL, &device);
    return device;
}

// A module, and a layout with the storage buffers that it declares.
static VkShaderModule load(VkDevice device, const char *path, VkPipelineLayout *layout) {
    FILE *file = fopen(path, "rb");
    if (!file) check(VK_ERROR_UNKNOWN, path);
    fseek(file, 0, SEEK_END);
    size_t bytes = ftell(file);
    rewind(file);
    uint32_t *words = malloc(bytes);
    if (fread(words, 1, bytes, file) != bytes) check(VK_ERROR_UNKNOWN, path);
    fclose(file);
    enum { DECORATE = 71, BINDING = 33 };
    VkDescriptorSetLayoutBinding bindings[64];
    uint32_t count = 0;
    for (size_t at = 5; at < bytes / 4; at += words[at] >> 16) {
        if ((words[at] & 0xffff) != DECORATE || words[at + 2] != BINDING || count == 64) continue;
        bindings[count++] = (VkDescriptorSetLayoutBinding){
            .binding = words[at + 3],
            .descriptorType = VK_DESCRIPTOR_TYPE_STORAGE_BUFFER,
            .descriptorCount = 1,
            .stageFlags = VK_SHADER_STAGE_COMPUTE_BIT,
        };
    }
    VkShaderModuleCreateInfo module_info = {
        .sType = VK_STRUCTURE_TYPE_SHADER_MODULE_CREATE_INFO,
        .codeSize = bytes,
        .pCode = words,
    };
    VkShaderModule module;
    CALL(vkCreateShaderModule, device, &module_info, NULL, &module);
    VkDescriptorSetLayoutCreateInfo set_info = {
        .sType = VK_STRUCTURE_TYPE_DESCRIPTOR_SET_LAYOUT_CREATE_INFO,
        .bindingCount = count,
        .pBindings = bindings,
    };
    VkDescriptorSetLayout set;
    CALL(vkCreateDescriptorSetLayout, device, &set_info, NULL, &set);
    VkPushConstantRange range = {.stageFlags = VK_SHADER_STAGE_COMPUTE_BIT, .size = 128};
    VkPipelineLayoutCreateInfo layout_info = {
        .sType = VK_STRUCTURE_TYPE_PIPELINE_LAYOUT_CREATE_INFO,
        .setLayoutCount = 1,
        .pSetLayouts = &set,
        .pushConstantRangeCount = 1,
        .pPushConstantRanges = &range,
    };
    CALL(vkCreatePipelineLayout, device, &layout_info, NULL, layout);
    return module;
}

static void print_statistics(VkDevice device, VkPipeline pipeline) {
    PFN_vkGetPipelineExecutableStatisticsKHR get =
        (PFN_vkGetPipelineExecutableStatisticsKHR)vkGetDeviceProcAddr(device, "vkGetPipelineExecutableStatisticsKHR");
    VkPipelineExecutableInfoKHR info = {.sType = VK_STRUCTURE_TYPE_PIPELINE_EXECUTABLE_INFO_KHR, .pipeline = pipeline};
    uint32_t count = 0;
    get(device, &info, &count, NULL);
    VkPipelineExecutableStatisticKHR *all = calloc(count, sizeof *all);
    for (uint32_t i = 0; i < count; i++) all[i].sType = VK_STRUCTURE_TYPE_PIPELINE_EXECUTABLE_STATISTIC_KHR;
    get(device, &info, &count, all);
    printf("{");
    for (uint32_t i = 0; i < count; i++)
        printf("%s\"%s\": %llu", i ? ", " : "", all[i].name, (unsigned long long)all[i].value.u64);
    printf("}\n");
    free(all);
}

int main(void) {
    VkDevice device = open_device();
    char line[4096];
    while (fgets(line, sizeof line, stdin)) {
        char *path = strtok(line, " \n"), *lanes = strtok(NULL, " \n"), *constant;
        VkSpecializationMapEntry entries[MAX_CONSTANTS];
        uint32_t bits[MAX_CONSTANTS], count = 0;
        while ((constant = strtok(NULL, " \n")) && count < MAX_CONSTANTS) {
            unsigned id;
            sscanf(constant, "%u=%u", &id, &bits[count]);
            entries[count] = (VkSpecializationMapEntry){id, 4 * count, 4};
            count++;
        }
        VkSpecializationInfo constants = {count, entries, 4 * count, bits};
        VkPipelineShaderStageRequiredSubgroupSizeCreateInfo size = {
            .sType = VK_STRUCTURE_TYPE_PIPELINE_SHADER_STAGE_REQUIRED_SUBGROUP_SIZE_CREATE_INFO,
            .requiredSubgroupSize = atoi(lanes),
        };
        int is_subgroup = size.requiredSubgroupSize > 0;
        VkPipelineLayout layout;
        VkComputePipelineCreateInfo info = {
            .sType = VK_STRUCTURE_TYPE_COMPUTE_PIPELINE_CREATE_INFO,
            .flags = VK_PIPELINE_CREATE_CAPTURE_STATISTICS_BIT_KHR,
            .stage = {
                .sType = VK_STRUCTURE_TYPE_PIPELINE_SHADER_STAGE_CREATE_INFO,
                .pNext = is_subgroup ? &size : NULL,
                .flags = is_subgroup ? VK_PIPELINE_SHADER_STAGE_CREATE_REQUIRE_FULL_SUBGROUPS_BIT : 0,
                .stage = VK_SHADER_STAGE_COMPUTE_BIT,
                .module = load(device, path, &layout),
                .pName = "main",
                .pSpecializationInfo = &constants,
            },
        };
        info.layout = layout;
        VkPipeline pipeline;
        CALL(vkCreateComputePipelines, device, VK_NULL_HANDLE, 1, &info, NULL, &pipeline);
        print_statistics(device, pipeline);
        fflush(stdout);
    }
    return 0;
}
