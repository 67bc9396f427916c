// What Fast DDS 2 and 3 name differently, under one name.

#pragma once

#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>

#if __has_include(<fastdds/config.hpp>)
#define FAST_DDS_3
#include <fastdds/LibrarySettings.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.hpp>
namespace rtps = eprosima::fastdds::rtps;
#else
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/xmlparser/XMLProfileManager.h>
namespace rtps = eprosima::fastrtps::rtps;
#endif

#include <cstdint>
#include <cstring>
#include <functional>

namespace fast = eprosima::fastdds::dds;

// Lets participants of one process exchange data through sockets, as those of several processes do.
inline void use_sockets()
{
#ifdef FAST_DDS_3
    eprosima::fastdds::LibrarySettings settings;
    settings.intraprocess_delivery = eprosima::fastdds::INTRAPROCESS_OFF;
    fast::DomainParticipantFactory::get_instance()->set_library_settings(settings);
#else
    eprosima::fastrtps::LibrarySettingsAttributes settings;
    settings.intraprocess_delivery = eprosima::fastrtps::INTRAPROCESS_OFF;
    eprosima::fastrtps::xmlparser::XMLProfileManager::library_settings(settings);
#endif
}

inline bool write_number(const void* value, rtps::SerializedPayload_t& payload)
{
    const unsigned char header[4] = {0, 1, 0, 0};
    std::memcpy(payload.data, header, 4);
    std::memcpy(payload.data + 4, value, 4);
    payload.length = 8;
    payload.encapsulation = CDR_LE;
    return true;
}

inline bool read_number(const rtps::SerializedPayload_t& payload, void* value)
{
    if (payload.length < 8)
    {
        return false;
    }
    std::memcpy(value, payload.data + 4, 4);
    return true;
}

// One number, in little-endian CDR.
class NumberType : public fast::TopicDataType
{
    using Payload = rtps::SerializedPayload_t;
    using Key = rtps::InstanceHandle_t;

public:
#ifdef FAST_DDS_3
    using Representation = fast::DataRepresentationId_t;

    NumberType()
    {
        set_name("sros::Number");
        max_serialized_type_size = 8;
    }

    bool serialize(const void* value, Payload& to, Representation) override { return write_number(value, to); }
    bool deserialize(Payload& from, void* value) override { return read_number(from, value); }
    uint32_t calculate_serialized_size(const void*, Representation) override { return 8; }
    void* create_data() override { return new std::uint32_t(0); }
    void delete_data(void* value) override { delete static_cast<std::uint32_t*>(value); }
    bool compute_key(Payload&, Key&, bool) override { return false; }
    bool compute_key(const void*, Key&, bool) override { return false; }
#else
    NumberType()
    {
        setName("sros::Number");
        m_typeSize = 8;
        auto_fill_type_information(false);
        auto_fill_type_object(false);
    }

    bool serialize(void* value, Payload* payload) override { return write_number(value, *payload); }
    bool deserialize(Payload* payload, void* value) override { return read_number(*payload, value); }
    std::function<uint32_t()> getSerializedSizeProvider(void*) override { return [] { return 8u; }; }
    void* createData() override { return new std::uint32_t(0); }
    void deleteData(void* value) override { delete static_cast<std::uint32_t*>(value); }
    bool getKey(void*, Key*, bool) override { return false; }
#endif
};
